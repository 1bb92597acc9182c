"""Covariance of the slopes' noise as low-rank patterns, and sandwich covariance of the registration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.blas import dtrmm

from escape_hw.api.synthetic_model import HasSystematicError, SyntheticModel
from escape_hw.calibration.sprint.weighted_matrix import WeightedMatrix

#: Singular values of the mirror's shapes, relative to the largest, below which the slopes do not show them.
_MIN_SINGULAR_RATIO = 1e-3
#: Least noise outside the mirror's shapes, in units of the variance of one slope.
_MIN_LEVEL = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class LowRankNoise:
    """Correlation of the noise of the slopes: patterns on top of a uniform level, and its inverse.

    The residual of whitened turbulence is smooth over the pupil, as the shapes of the mirror are, and a
    uniform level is enough outside them. The principal shapes of the mirror stand for those of the noise:
    a few frames determine their variances, whereas the inverse of the covariance of a thousand slopes, or
    its own principal patterns, need many thousand frames.

    Parameters
    ----------
    level
        Variance outside the patterns, relative to the variances of the slopes.
    patterns
        Orthonormal ``(n_slopes, n_patterns)``.
    variances
        Variances of the patterns ``(n_patterns,)``.
    """

    level: float
    patterns: NDArray[np.float64]
    variances: NDArray[np.float64]

    @classmethod
    def from_covariance(cls, covariance: NDArray[np.float64], zonal: NDArray[np.float64]) -> LowRankNoise:
        """Project a measured covariance on the shapes of the mirror.

        Parameters
        ----------
        covariance
            Covariance of the noise of the slopes ``(n_slopes, n_slopes)``, up to a factor, from any number
            of frames.
        zonal
            Slopes per unit command ``(n_slopes, n_act)``, in units of the noise of the slopes.
        """
        standard_deviation = np.sqrt(np.diag(covariance))
        shapes, values, _ = np.linalg.svd(zonal, full_matrices=False)
        shapes = shapes[:, values > _MIN_SINGULAR_RATIO * values[0]]
        correlation = covariance / np.outer(standard_deviation, standard_deviation)
        variances = (shapes * (correlation @ shapes)).sum(axis=0)
        n_slopes, n_patterns = shapes.shape
        # The trace of the correlation is n_slopes.
        level = max(n_slopes - float(variances.sum()), _MIN_LEVEL) / max(n_slopes - n_patterns, 1)
        return cls(level, shapes, np.maximum(variances, level))

    def inverse(self) -> NDArray[np.float64]:
        """The inverse of the correlation ``(n_slopes, n_slopes)``."""
        correction = (1 / self.variances - 1 / self.level) * self.patterns
        return np.asarray(np.eye(len(self.patterns)) / self.level + correction @ self.patterns.T)


#: Groups of actuators, and rings of sub-apertures, that are left out in turn.
_N_GROUPS, _N_RINGS = 20, 4
#: Distance at which scores count as independent, in larger sides of the grid of sub-apertures.
_WINDOW = 0.5
#: Slopes whose projections on all actuators are in memory at once.
_SLOPES_AT_ONCE = 256


def systematic_error(model: SyntheticModel) -> NDArray[np.float64]:
    """Standard errors of the model's own registration ``(5,)``; 0 if it states none."""
    return model.registration_systematic_error if isinstance(model, HasSystematicError) else np.zeros(5)


class LinearisedProblem(Protocol):
    """A least-squares problem linearised at its solution."""

    @property
    def residual(self) -> NDArray[np.float64]:
        """Data minus model ``(n_slopes, n_modes)``, in standard errors."""
        ...

    def information(self) -> NDArray[np.float64]:
        """Information on gain, registration and the parameters after them ``(n, n)``."""
        ...

    def projected_jacobian(self) -> NDArray[np.float64]:
        """Derivatives by the same parameters ``(n, n_slopes, n_modes)``, orthogonal to all others."""
        ...


def _bartlett_windows(valid: NDArray[np.bool_]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Bartlett windows of the distances of rows and columns: 1, falling to 0 at :data:`_WINDOW`."""
    half_width = _WINDOW * max(valid.shape)
    rows, columns = (np.arange(n, dtype=float) for n in valid.shape)
    row_window, column_window = (
        np.maximum(1 - np.abs(at[:, None] - at) / half_width, 0.0) for at in (rows, columns)
    )
    return row_window, column_window


def _sum_by_proximity(valid: NDArray[np.bool_], scores: NDArray[np.float64]) -> NDArray[np.float64]:
    """Windowed sums of scores ``(n, n_valid)`` around every sub-aperture."""
    row_window, column_window = _bartlett_windows(valid)
    maps = np.zeros((len(scores), *valid.shape))
    maps[:, valid] = scores
    return np.asarray((row_window @ maps @ column_window)[:, valid])


def _proximity(valid: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Window of every pair of valid sub-apertures ``(n_valid, n_valid)``."""
    row_window, column_window = _bartlett_windows(valid)
    rows, columns = np.nonzero(valid)
    return np.asarray(row_window[np.ix_(rows, rows)] * column_window[np.ix_(columns, columns)])


def _noise_score_covariance(
    scores: NDArray[np.float64], correlation: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Covariance of the summed scores ``(n, n)`` due to a correlation of the noise of the slopes.

    ``scores (n, n_slopes, n_modes)``; ``correlation (n_slopes, n_slopes)``, which must be symmetric.
    """
    # One triangle with half of the diagonal gives half of the sum, the other is its transpose.
    half = correlation.copy()
    half[np.diag_indices(len(half))] /= 2
    by_mode = np.ascontiguousarray(scores.transpose(0, 2, 1)).reshape(-1, len(half))
    correlated = dtrmm(1.0, half.T, by_mode.T).T
    covariance = by_mode.reshape(len(scores), -1) @ correlated.reshape(len(scores), -1).T
    return np.asarray(covariance + covariance.T)


def _with_variances(matrix: NDArray[np.float64], variances: NDArray[np.float64]) -> NDArray[np.float64]:
    """The covariance ``(n, n)`` with other variances ``(n,)`` and the same correlations."""
    own = np.diag(matrix)
    known = own > 0
    scale = np.sqrt(np.divide(variances, own, out=np.zeros_like(own), where=known))
    return np.asarray(matrix * np.outer(scale, scale) + np.diag(np.where(known, 0.0, variances)))


def _resampled_covariance(
    total: NDArray[np.float64],
    scores: NDArray[np.float64],
    residual: NDArray[np.float64],
    modes: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Covariance of the common parameters from leaving out groups of actuators in turn ``(n, n)``.

    The delete-group jackknife (Shao & Tu 1995, section 2.3) of the linearised solution. The score of an
    actuator follows from the derivative of its column, ``J M^+``, and the residual that its commands cause,
    ``r M^T``.

    Parameters
    ----------
    total
        Information on the parameters, priors included ``(n, n)``.
    scores
        Projected derivatives ``(n, n_slopes, n_modes)``.
    residual, modes
        Residual ``(n_slopes, n_modes)`` and modes ``(n_act, n_modes)``.
    """
    (n, n_slopes, n_modes), n_act = scores.shape, len(modes)
    inverse, commanded_residual = np.linalg.pinv(modes).T, modes @ residual.T
    information, by_actuator = np.zeros((n_act, n, n)), np.zeros((n_act, n))
    for first in range(0, n_slopes, _SLOPES_AT_ONCE):
        part = slice(first, first + _SLOPES_AT_ONCE)
        columns = scores[:, part].reshape(-1, n_modes).T
        zonal, commanded = ((rows @ columns).reshape(n_act, n, -1) for rows in (inverse, modes))
        information += zonal @ commanded.transpose(0, 2, 1)
        by_actuator += (zonal @ commanded_residual[:, part, None])[:, :, 0]
    steps: list[NDArray[np.float64]] = []
    for group in np.array_split(np.arange(n_act), min(_N_GROUPS, n_act)):
        left_out = information[group].sum(axis=0)
        steps.append(np.linalg.solve(total - (left_out + left_out.T) / 2, by_actuator[group].sum(axis=0)))
    return _jackknife_covariance(steps)


def _resampled_by_slopes(
    total: NDArray[np.float64],
    scores: NDArray[np.float64],
    residual: NDArray[np.float64],
    valid: NDArray[np.bool_],
) -> NDArray[np.float64]:
    """The same from leaving out the x or y slopes of a ring of sub-apertures in turn ``(n, n)``.

    Errors of a model of the sensor depend on the direction of the slopes and the distance from the rim.
    """
    rows, columns = np.nonzero(valid)
    centre = (np.array(valid.shape) - 1) / 2
    by_radius = np.argsort(np.hypot(rows - centre[0], columns - centre[1]), kind="stable")
    steps: list[NDArray[np.float64]] = []
    for ring in np.array_split(by_radius, _N_RINGS):
        for group in (ring, ring + len(rows)):
            part = scores[:, group].reshape(len(scores), -1)
            step = np.linalg.solve(total - part @ part.T, -part @ residual[group].ravel())
            steps.append(np.asarray(step))
    return _jackknife_covariance(steps)


def _jackknife_covariance(steps: list[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Covariance ``(n, n)`` from the steps that leaving out each group causes."""
    deviations = np.array(steps) - np.mean(steps, axis=0)
    return np.asarray(deviations.T @ deviations * (len(steps) - 1) / len(steps))


def sandwich_covariance(
    weighted: WeightedMatrix,
    system: LinearisedProblem,
    noise: NDArray[np.float64] | None,
    least_factor: float = 1.0,
) -> NDArray[np.float64]:
    """Sandwich covariance of the common parameters, in their units.

    The middle factor is the covariance of the scores due to the noise. It follows from the covariance of the
    noise, where that is known: turbulence correlates neighbouring sub-apertures. Otherwise it is estimated
    from the scatter of the scores over the pupil: products of scores are weighted with a Bartlett window
    that falls to zero at half the pupil (as in Newey & West 1987 over time), plus the scatter of the scores
    from mode to mode, which contains errors common to all slopes during the measurement of a mode.

    Misfits of the model are in the residual as well, so each of the following estimates the whole variance
    of a parameter, and the largest is stated:

    - the noise, plus what the scatter of the scores over the pupil exceeds that of the noise (only the
      excess: the scores at a solution sum to zero, and the window alone would underestimate the noise);
    - independent errors of the slopes;
    - leaving out groups of slopes, or groups of actuators (:func:`_resampled_by_slopes`,
      :func:`_resampled_covariance`).

    A reduced chi-squared above one multiplies the whole covariance (the scale factor of Birge 1932): a
    misfit that all groups share, such as that of another family of influence functions, does not show when
    some are left out.

    Parameters
    ----------
    weighted, system
        The measured matrix, and the problem linearised at its solution.
    noise
        Covariance of the noise of the slopes ``(n_slopes, n_slopes)`` up to a factor, where it is known.
    least_factor
        Factor of the standard errors for a misfit that is seen elsewhere than in the residual.
    """
    bread = np.linalg.inv(system.information())
    scores, valid = system.projected_jacobian(), weighted.valid
    element_scores = scores * system.residual
    # The x and y slopes of a sub-aperture share its position.
    by_sub_aperture = element_scores.sum(axis=2).reshape(len(element_scores), 2, -1).sum(axis=1)
    meat = by_sub_aperture @ _sum_by_proximity(valid, by_sub_aperture).T
    power = weighted.noise_level(system.residual) ** 2
    if noise is None:
        by_mode = element_scores.sum(axis=1)
        covariance = bread @ (meat + by_mode @ by_mode.T) @ bread
        excess = np.zeros(len(bread))
    else:
        # A slope without variance is uncorrelated with all others.
        standard_deviation = np.where(np.diag(noise) > 0, np.sqrt(np.diag(noise)), np.inf)
        correlation = power * noise / np.outer(standard_deviation, standard_deviation)
        near_correlation = np.tile(_proximity(valid), (2, 2)) * correlation
        covariance = bread @ _noise_score_covariance(scores, correlation) @ bread
        near = _noise_score_covariance(scores, near_correlation)
        excess = np.maximum(np.diag(bread @ (meat - near) @ bread), 0.0)
    information = system.information()
    estimates = (
        np.diag(covariance) + excess,
        power * np.diag(bread),
        np.diag(_resampled_by_slopes(information, scores, system.residual, valid)),
        np.diag(_resampled_covariance(information, scores, system.residual, weighted.modes)),
    )
    scale_factor = max(weighted.reduced_chi_squared(system.residual) / power, least_factor**2)
    return _with_variances(covariance, np.max(estimates, axis=0) * scale_factor)
