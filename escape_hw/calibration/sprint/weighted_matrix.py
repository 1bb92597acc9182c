"""An interaction matrix in units of its standard errors, and weights of its slopes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.synthetic_model import HasSlopeWeights, SyntheticModel

#: Residual of a sub-aperture, relative to the median one, up to which its weight is 1.
_HUBER_THRESHOLD = 1.5
#: Iterations of weighting and fitting; the weights hardly change after the second.
HUBER_ITERATIONS = 3
#: Least noise of a matrix without standard errors, relative to its rms: nothing is measured better.
_LEAST_NOISE = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class WeightedMatrix:
    """Columns of an interaction matrix, each element divided by its standard error.

    The standard errors factor into the noise of the slopes and the excitation of the modes, as both
    DO-CRIME estimators state them.

    Parameters
    ----------
    data
        ``(n_slopes, n_modes)``, in standard errors.
    by_slope, by_mode
        The factors ``(n_slopes,)`` and ``(n_modes,)`` that the matrix was divided by.
    m2c
        Mode-to-command matrix of the columns ``(n_act, n_modes)``.
    has_standard_errors
        Whether the matrix came with standard errors; if not, they are taken as equal: first as the rms of the
        matrix, and then as that of the residual of a fit (:meth:`in_units_of`).
    valid
        Valid sub-apertures ``(n_rows, n_columns)``.
    slope_weights
        Weights of the squares of the slopes ``(n_slopes,)``, which ``data`` contains: the variance of their
        noise in its units.
    """

    data: NDArray[np.float64]
    by_slope: NDArray[np.float64]
    by_mode: NDArray[np.float64]
    m2c: NDArray[np.float64]
    has_standard_errors: bool
    valid: NDArray[np.bool_]
    slope_weights: NDArray[np.float64] | float = 1.0

    @classmethod
    def from_columns(cls, matrix: InteractionMatrix, columns: NDArray[np.intp]) -> WeightedMatrix:
        """Weight the given columns of a matrix."""
        data = matrix.data[:, columns].astype(float)
        sigma = matrix.sigma[:, columns].astype(float)
        has_standard_errors = bool((sigma > 0).all())
        if has_standard_errors:
            log_sigma = np.log(sigma)
            by_slope = np.exp(log_sigma.mean(axis=1) - log_sigma.mean())
            by_mode = np.exp(log_sigma.mean(axis=0))
        else:
            by_slope = np.ones(data.shape[0])
            by_mode = np.full(data.shape[1], max(float(data.std()), 1e-30))
        m2c = matrix.m2c[:, columns]
        return cls(
            data / by_slope[:, None] / by_mode, by_slope, by_mode, m2c, has_standard_errors, matrix.valid
        )

    def columns(self, which: slice) -> WeightedMatrix:
        """Some of the columns."""
        return replace(self, data=self.data[:, which], by_mode=self.by_mode[which], m2c=self.m2c[:, which])

    def with_slope_weights(self, weights: NDArray[np.float64]) -> WeightedMatrix:
        """The same with the squares of every slope multiplied by a weight ``(n_slopes,)``."""
        root = np.sqrt(weights)
        return replace(
            self, data=self.data * root[:, None], by_slope=self.by_slope / root,
            slope_weights=self.slope_weights * weights,
        )  # fmt: skip

    def in_units_of(self, residual: NDArray[np.float64]) -> WeightedMatrix:
        """The same in units of the rms of a residual ``(n_slopes, n_modes)``; unchanged with standard errors.

        The priors of a fit are relative to the noise: were it overstated, they would outweigh the matrix.
        """
        if self.has_standard_errors:
            return self
        level = max(self.noise_level(residual), _LEAST_NOISE * float(self.data.std()))
        return replace(self, data=self.data / level, by_mode=self.by_mode * level)

    @property
    def modes(self) -> NDArray[np.float64]:
        """The modes ``(n_act, n_modes)``, scaled so that the typical standard error of a column is 1."""
        return self.m2c / self.by_mode

    def weigh(self, slopes: NDArray[np.float64]) -> NDArray[np.float64]:
        """Slopes ``(..., n_slopes, n)`` in units of their noise."""
        return np.asarray(slopes / self.by_slope[:, None])

    @property
    def noise_variances(self) -> NDArray[np.float64]:
        """Variance of the noise of every slope ``(n_slopes,)`` in units of the data."""
        return np.asarray(np.broadcast_to(self.slope_weights, len(self.data)), float)

    @property
    def expected_noise(self) -> float:
        """Expected sum of squares of the noise."""
        return float(self.noise_variances.sum() * self.data.shape[1])

    def reduced_chi_squared(self, residual: NDArray[np.float64]) -> float:
        """Sum of squares of a residual ``(n_slopes, n_modes)`` relative to that of the noise."""
        return float(np.square(residual).sum() / self.expected_noise)

    @property
    def signal_fraction(self) -> float:
        """Fraction of the sum of squares that is not noise."""
        if not self.has_standard_errors:
            return 1.0
        return max(1 - self.expected_noise / float(np.square(self.data).sum()), 0.0)

    def noise_level(self, residual: NDArray[np.float64]) -> float:
        """Noise of an element in units of the data: 1, or the rms residual without standard errors."""
        return 1.0 if self.has_standard_errors else float(np.sqrt(self.reduced_chi_squared(residual)))

    def explained_fraction(self, residual: NDArray[np.float64]) -> float:
        """Fraction of the sum of squares that a model with this residual explains."""
        return 1 - float(np.square(residual).sum() / np.square(self.data).sum())


def apply_model_weights(weighted: WeightedMatrix, model: SyntheticModel) -> WeightedMatrix:
    """The matrix with the slope weights of the model, if it has any (``HasSlopeWeights``)."""
    return (
        weighted.with_slope_weights(model.slope_weights) if isinstance(model, HasSlopeWeights) else weighted
    )


def huber_weights(residual: NDArray[np.float64]) -> NDArray[np.float64]:
    """Outlier weight of the squares of every slope ``(n_slopes,)``, in (0, 1].

    The weights of Huber (1964), for sub-apertures instead of elements: dirt, a broken lenslet or a wrong
    window affect a sub-aperture in all modes and in both slopes.

    Parameters
    ----------
    residual
        Residual of a fit ``(n_slopes, n_modes)`` in standard errors, all x then all y.
    """
    by_sub_aperture = np.square(residual).mean(axis=1).reshape(2, -1).mean(axis=0)
    size = np.sqrt(by_sub_aperture / max(float(np.median(by_sub_aperture)), 1e-300))
    return np.tile(np.minimum(1.0, _HUBER_THRESHOLD / np.maximum(size, 1e-300)), 2)
