"""What DO-CRIME found, and how its sums say so."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.brief import brief
from escape_hw.api.results import TemporalResponse
from escape_hw.calibration.docrime_fit import require_excitation
from escape_hw.calibration.regression import RegressionSums
from escape_hw.calibration.response import ResponseTracker
from escape_hw.calibration.significance import require_response


@dataclass(frozen=True, slots=True, eq=False)
class DocrimeSolution:
    """A solved DO-CRIME run.

    Parameters
    ----------
    matrix, sigma
        ``(n_slopes, n_modes)``: slopes per unit mode, and standard errors of single elements beside a
        gain that they share.
    covariance
        Covariance of one frame's filtered residual slopes ``(n_slopes, n_slopes)``; ``None`` where
        correlations were not asked for.
    gram
        Sum over frames of filtered pokes times filtered pokes ``(n_modes, n_modes)``; in closed loop
        what stands in its place: the inverse of the covariance of a row of the matrix, per variance of
        its slope's noise.
    variance
        Variance of each slope's filtered noise, with what its correlation over time adds ``(n_slopes,)``.
    whitener
        The filter used, ``[1]`` for the plain estimator.
    gain_sigma
        Relative standard error of the gain that all elements share: an error of the temporal response,
        which is scaled to sum 1, scales the whole matrix.
    response_covariance
        Of the response's weights ``(lags, lags)``.
    """

    matrix: NDArray[np.float64]
    sigma: NDArray[np.float64]
    response: TemporalResponse
    covariance: NDArray[np.float64] | None
    gram: NDArray[np.float64]
    variance: NDArray[np.float64]
    whitener: NDArray[np.float64]
    frames: int
    lost_frames: int
    gain_sigma: float
    response_covariance: NDArray[np.float64]
    __repr__ = brief


def solution_of(
    whole: RegressionSums,
    tracker: ResponseTracker,
    whitener: NDArray[np.float64],
    spread: float,
    *,
    lags: int,
    frames: int,
    lost_frames: int,
) -> DocrimeSolution:
    """The matrix, its standard errors and the temporal response that sums hold.

    Parameters
    ----------
    whole
        Sums over all filtered frames, of slopes and of what the pokes made of them; not changed.
    tracker
        Follows the temporal response over the same frames.
    whitener
        The filter ``(order + 1,)``; one weight is none, and then nothing tells whether the mirror responds.
    spread
        Factor on the variance of an estimate whose noise is not white.
    lags
        Frames over which the temporal response was estimated.
    frames, lost_frames
        As the solution tells them.

    Raises
    ------
    CalibrationError
        The mirror does not respond, or the pokes do not span the modes.
    """
    sums = whole.centred()
    information = sums.information()
    require_excitation(information)
    matrix = sums.solve()
    freedom = sums.freedom() - lags
    if whitener.size > 1:
        rows, power = sums.sample(matrix)
        require_response(information, rows, power / freedom, lags)
    residual = sums.residual_power(matrix) / freedom
    covariance = residual if residual.ndim == 2 else None
    variance = np.maximum(residual if covariance is None else np.diag(residual), 0.0) * spread
    sigma = np.outer(np.sqrt(variance), np.sqrt(sums.inverse_diagonal()))
    response = tracker.response()
    scale = tracker.scale(response)
    return DocrimeSolution(
        matrix * scale,
        sigma * np.abs(scale),
        response.response,
        covariance,
        information / np.multiply.outer(scale, scale),
        variance,
        whitener,
        frames,
        lost_frames,
        tracker.gain_sigma(response),
        response.covariance,
    )
