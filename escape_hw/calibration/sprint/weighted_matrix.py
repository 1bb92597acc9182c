"""A measured matrix in units of its standard errors."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.interaction_matrix import InteractionMatrix


@dataclass(frozen=True, slots=True, eq=False)
class WeightedMatrix:
    """Columns of an interaction matrix, each element divided by its standard error.

    Standard errors factor into slopes' noise and modes' excitation: both estimators say so.

    Parameters
    ----------
    data
        ``(n_slopes, n_modes)``, in standard errors.
    by_slope, by_mode
        The factors ``(n_slopes,)`` and ``(n_modes,)`` that it was divided by.
    m2c
        Mode-to-command matrix of the columns ``(n_act, n_modes)``.
    measured
        Whether the matrix came with standard errors; if not, they are taken as equal.
    valid
        Valid sub-apertures ``(n_rows, n_columns)``.
    """

    data: NDArray[np.float64]
    by_slope: NDArray[np.float64]
    by_mode: NDArray[np.float64]
    m2c: NDArray[np.float64]
    has_standard_errors: bool
    valid: NDArray[np.bool_]

    @classmethod
    def of(cls, matrix: InteractionMatrix, columns: NDArray[np.intp]) -> WeightedMatrix:
        """Weigh some columns of a matrix."""
        data = matrix.data[:, columns].astype(float)
        sigma = matrix.sigma[:, columns].astype(float)
        has_standard_errors = bool((sigma > 0).all())
        if has_standard_errors:
            power = np.log(sigma)
            by_slope = np.exp(power.mean(axis=1) - power.mean())
            by_mode = np.exp(power.mean(axis=0))
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

    def with_slope_weights(self, share: NDArray[np.float64]) -> WeightedMatrix:
        """The same with the squares of every slope weighted by a share ``(n_slopes,)``."""
        root = np.sqrt(share)
        return replace(self, data=self.data * root[:, None], by_slope=self.by_slope / root)

    @property
    def modes(self) -> NDArray[np.float64]:
        """The modes in units in which a column's typical standard error is 1, ``(n_act, n_modes)``."""
        return self.m2c / self.by_mode

    def weigh(self, slopes: NDArray[np.float64]) -> NDArray[np.float64]:
        """Slopes ``(..., n_slopes, n)`` in units of their noise."""
        return np.asarray(slopes / self.by_slope[:, None])

    @property
    def signal_fraction(self) -> float:
        """Share of the squared elements that is not noise."""
        if not self.has_standard_errors:
            return 1.0
        return max(1 - self.data.size / float(np.square(self.data).sum()), 0.0)

    def noise(self, residual: NDArray[np.float64]) -> float:
        """Noise of an element in the units of the data: 1, or the rms residual where no errors came."""
        return 1.0 if self.has_standard_errors else float(np.sqrt(np.mean(np.square(residual))))

    def explained_fraction(self, residual: NDArray[np.float64]) -> float:
        """Share of the squared elements that a model leaves no residual of."""
        return 1 - float(np.square(residual).sum() / np.square(self.data).sum())
