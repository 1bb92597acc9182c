"""Covariance of the slopes' noise as low-rank patterns, and sandwich covariance of the registration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from escape_hw.calibration.sprint.weighted_matrix import WeightedMatrix

#: Singular values of the mirror's shapes below which slopes do not show them, of the largest.
_MIN_SINGULAR_RATIO = 1e-3
#: Slopes' worth of noise beyond the mirror's shapes, where a covariance has none.
_MIN_LEVEL = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class LowRankNoise:
    """Correlation of the slopes' noise as patterns on top of a level, and so its inverse.

    What turbulence leaves after whitening is smooth over the pupil, so it looks like shapes of the mirror;
    beyond them a level is enough. The principal shapes of the mirror stand for the noise's own: their
    variances alone are told by few frames, where the inverse of a covariance of a thousand slopes takes
    many thousand, and the noise's own principal patterns nearly as many.

    Parameters
    ----------
    level
        Variance outside the patterns, of the slopes' own variances.
    patterns
        Orthonormal ``(n_slopes, n_patterns)``.
    variances
        Of the patterns ``(n_patterns,)``.
    """

    level: float
    patterns: NDArray[np.float64]
    variances: NDArray[np.float64]

    @classmethod
    def of(cls, covariance: NDArray[np.float64], zonal: NDArray[np.float64]) -> LowRankNoise:
        """The patterns of a measured covariance.

        Parameters
        ----------
        covariance
            Of the slopes' noise ``(n_slopes, n_slopes)``, up to a factor, from any number of frames.
        zonal
            What the mirror can make: slopes per unit command ``(n_slopes, n_act)``, in units of the slopes'
            noise.
        """
        standard_deviation = np.sqrt(np.diag(covariance))
        shapes, values, _ = np.linalg.svd(zonal, full_matrices=False)
        shapes = shapes[:, values > _MIN_SINGULAR_RATIO * values[0]]
        correlation = covariance / np.outer(standard_deviation, standard_deviation)
        variances = (shapes * (correlation @ shapes)).sum(axis=0)
        n_slopes, n_patterns = shapes.shape
        # Each slope has a variance of 1.
        level = max(n_slopes - float(variances.sum()), _MIN_LEVEL) / max(n_slopes - n_patterns, 1)
        return cls(level, shapes, np.maximum(variances, level))

    def inverse(self) -> NDArray[np.float64]:
        """The inverse of the correlation ``(n_slopes, n_slopes)``."""
        correction = (1 / self.variances - 1 / self.level) * self.patterns
        return np.asarray(np.eye(len(self.patterns)) / self.level + correction @ self.patterns.T)


#: What the synthetic model gets wrong in common over the whole pupil, in the units of the parameters:
#: rms over random plants on a twin with all imperfections, when noise no longer counts (docs/decisions).
MODEL_ERROR_FLOOR = np.array([0.03, 0.03, 0.0, 0.045, 0.018])


class LinearisedProblem(Protocol):
    """A least-squares problem about its solution."""

    @property
    def residual(self) -> NDArray[np.float64]:
        """What is left ``(n_slopes, n_modes)``, in standard errors."""
        ...

    def information(self) -> NDArray[np.float64]:
        """Information on gain, registration and whatever comes after them ``(n, n)``."""
        ...

    def projected_jacobian(self) -> NDArray[np.float64]:
        """Derivatives by the same parameters ``(n, n_slopes, n_modes)``, less what is not theirs."""
        ...


def _bartlett_windows(valid: NDArray[np.bool_]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """How near rows and columns are to each other: 1, falling to 0 at half the larger side of ``valid``."""
    half_width = max(valid.shape) / 2
    rows, columns = (np.arange(n, dtype=float) for n in valid.shape)
    row_window, column_window = (
        np.maximum(1 - np.abs(at[:, None] - at) / half_width, 0.0) for at in (rows, columns)
    )
    return row_window, column_window


def _sum_by_proximity(valid: NDArray[np.bool_], scores: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sums of scores ``(n, n_valid)`` over sub-apertures by nearness; along rows, then along columns."""
    row_window, column_window = _bartlett_windows(valid)
    maps = np.zeros((len(scores), *valid.shape))
    maps[:, valid] = scores
    return np.asarray((row_window @ maps @ column_window)[:, valid])


def _proximity(valid: NDArray[np.bool_]) -> NDArray[np.float64]:
    """How near valid sub-apertures are to each other ``(n_valid, n_valid)``, 1 in one place."""
    row_window, column_window = _bartlett_windows(valid)
    rows, columns = np.nonzero(valid)
    return np.asarray(row_window[np.ix_(rows, rows)] * column_window[np.ix_(columns, columns)])


def _noise_score_covariance(
    scores: NDArray[np.float64], correlation: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Covariance of summed scores ``(n, n)`` that a correlation of the slopes' noise makes."""
    standard_deviation = np.matmul(correlation, scores).reshape(len(scores), -1)
    return np.asarray(scores.reshape(len(scores), -1) @ standard_deviation.T)


def _positive_part(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """The part of a symmetric matrix with positive eigenvalues."""
    values, directions = np.linalg.eigh((matrix + matrix.T) / 2)
    return np.asarray((directions * np.maximum(values, 0.0)) @ directions.T)


def sandwich_covariance(
    weighted: WeightedMatrix, system: LinearisedProblem, noise: NDArray[np.float64] | None
) -> NDArray[np.float64]:
    """Sandwich covariance of the common parameters, in units of their own.

    The middle is the covariance of the scores. What the noise makes of them is told by its own
    covariance, where it is known: neighbouring sub-apertures err together. What the model misses has
    its own pattern over the pupil and is in their scatter, so products of scores count with a weight that
    falls linearly with the distance to zero at half the pupil (Bartlett's window, as in Newey & West 1987
    over time), and only what they show beyond the noise is added: the scores of a solution sum to
    nothing, so the window alone takes the noise for smaller than it is. Without a covariance the window is
    all there is, and beyond it the scatter of the scores from mode to mode, which shows what moved all slopes
    together while one mode was measured. What is common to the whole pupil no scatter can show; :data:`MODEL_ERROR_FLOOR`
    stands for it.

    Parameters
    ----------
    weighted
        The measured matrix.
    system
        The problem about its solution.
    noise
        Covariance of the slopes' noise ``(n_slopes, n_slopes)`` up to a factor, where it is known.
    """
    bread = np.linalg.inv(system.information())
    scores, valid = system.projected_jacobian(), weighted.valid
    element_scores = scores * system.residual
    # Slopes along x and along y of one sub-aperture stand in one place.
    by_place = element_scores.sum(axis=2).reshape(len(element_scores), 2, -1).sum(axis=1)
    meat = by_place @ _sum_by_proximity(valid, by_place).T
    power = weighted.noise(system.residual) ** 2
    if noise is None:
        by_mode = element_scores.sum(axis=1)
        meat += by_mode @ by_mode.T
    else:
        # A slope that never moved has no noise to share.
        standard_deviation = np.where(np.diag(noise) > 0, np.sqrt(np.diag(noise)), np.inf)
        correlation = power * noise / np.outer(standard_deviation, standard_deviation)
        near_correlation = np.tile(_proximity(valid), (2, 2)) * correlation
        # What the scatter shows beyond the noise is the model's.
        meat = _noise_score_covariance(scores, correlation) + _positive_part(
            meat - _noise_score_covariance(scores, near_correlation)
        )
    estimate = bread @ meat @ bread
    # Never better than the noise alone allows.
    scale = np.sqrt(np.maximum(power * np.diag(bread) / np.diag(estimate), 1.0))
    covariance = estimate * np.outer(scale, scale)
    covariance[np.arange(1, 6), np.arange(1, 6)] += np.square(MODEL_ERROR_FLOOR)
    return np.asarray(covariance)
