"""Uncertainty of differences between runs of one set-up.

The standard errors of a registration contain what its model does not know of the mirror and the sensor. That
is the same in every run of a set-up and drops out of differences between runs; the noise does not.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.synthetic_model import SyntheticModel
from escape_hw.calibration.sprint.covariance import LinearisedProblem, systematic_error
from escape_hw.calibration.sprint.weighted_matrix import WeightedMatrix

#: Median of the square of a normal variable of unit variance.
_MEDIAN_SQUARE = 0.454936


def repeatability_covariance(
    weighted: WeightedMatrix,
    system: LinearisedProblem,
    noise: NDArray[np.float64] | None,
    model: SyntheticModel,
) -> NDArray[np.float64]:
    """Covariance of the registration between runs of one set-up ``(5, 5)``.

    The registration is linear in the data about the solution, so the covariance follows from that of the
    noise. Where that is not known, the contribution of a column to a parameter has the variance that the
    residuals of the *other* columns have under the same weights: noise is everywhere, and the misfit of an
    influence function is near its actuator, so the median over the columns is hardly affected by it. Noise
    that is correlated over the pupil, as by air or vibration, is included. The errors that a model states of
    its own registration are those of its turbulence and of its images, which differ from run to run.

    Parameters
    ----------
    weighted, system
        The measured matrix, and the problem linearised at its solution.
    noise
        Covariance of the noise of the slopes ``(n_slopes, n_slopes)`` up to a factor, where it is known.
    model
        The synthetic model.
    """
    scores, inverse = system.projected_jacobian(), np.linalg.inv(system.information())
    weights = np.einsum("pq,qsm->psm", inverse[1:6], scores, optimize=True)
    flat = weights.reshape(5, -1)
    white = flat @ flat.T
    if noise is not None:
        sigma = np.where(np.diag(noise) > 0, np.sqrt(np.diag(noise)), np.inf)
        covariance = flat @ np.matmul(noise / np.outer(sigma, sigma), weights).reshape(5, -1).T
        covariance *= weighted.noise_level(system.residual) ** 2
    else:
        variance = _variance_from_other_columns(weights, system.residual)
        if weighted.has_standard_errors:
            variance = np.maximum(variance, np.diag(white))
        scale = np.sqrt(variance / np.diag(white))
        covariance = white * np.outer(scale, scale)
    return np.asarray(covariance + np.diag(np.square(systematic_error(model))))


def _variance_from_other_columns(
    weights: NDArray[np.float64], residual: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Variance of the sum over all columns of weights times residual ``(n,)``.

    Parameters
    ----------
    weights
        ``(n, n_slopes, n_columns)``.
    residual
        ``(n_slopes, n_columns)``.
    """
    n_columns = residual.shape[1]
    variance = np.zeros(len(weights))
    for number, one in enumerate(weights):
        square = np.square(one.T @ residual)
        if n_columns > 1:
            square = square[~np.eye(n_columns, dtype=bool)].reshape(n_columns, n_columns - 1)
        variance[number] = np.median(square, axis=1).sum() / _MEDIAN_SQUARE
    return variance
