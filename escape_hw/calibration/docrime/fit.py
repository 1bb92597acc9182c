"""Fit of the first frames (temporal response, whitening filter), significance tests, solution of the sums."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from escape_hw.api.representation import short_repr
from escape_hw.api.results import TemporalResponse
from escape_hw.calibration.acquisition.aligned_telemetry import AlignedTelemetry
from escape_hw.calibration.docrime.regression import InstrumentalVariableSums, RegressionSums
from escape_hw.calibration.docrime.response import (
    RESPONSE_SLOPES,
    FilteredTelemetry,
    ResponseEstimate,
    ResponseTracker,
    filter_telemetry,
    find_usable_rows,
    fit_response,
    require_no_late_response,
)
from escape_hw.calibration.docrime.whitening import apply_filter, fit_prediction_error_filter
from escape_hw.errors import CalibrationError

#: Standard deviations by which the pokes must explain more of the slopes than chance.
_MIN_SIGNIFICANCE = 5.0
#: Factor on the chance level for noise that is not white: one filter for all slopes leaves some correlation
#: in each slope, and without a response the estimated one is broad.
_COLOURED_NOISE_FACTOR = 1.5
#: Least reciprocal condition number of the information on the modes.
_MIN_RECIPROCAL_CONDITION = 1e-7
#: Degrees of freedom from which on standard errors are stated.
MIN_DEGREES_OF_FREEDOM = 20
#: Number of slopes from which the filter, common to all, is estimated.
_FILTER_SLOPES = 32


def require_response(
    gram: NDArray[np.floating], matrix: NDArray[np.floating], covariance: NDArray[np.floating], lags: int
) -> None:
    """Raise unless the pokes explain more of the slopes than chance does.

    Without a response the pokes explain as much power as the noise has, with the scatter of as many degrees
    of freedom as modes times independent slopes. The choice of the temporal response that explains most adds
    the excess of the largest eigenvalue of a Wishart matrix over the mean (Marchenko & Pastur 1967).

    Parameters
    ----------
    gram
        Sum of pokes times pokes ``(n_modes, n_modes)``.
    matrix
        Least-squares matrix ``(n_slopes, n_modes)``.
    covariance
        Covariance of the noise of one frame's slopes ``(n_slopes, n_slopes)``.

    Raises
    ------
    CalibrationError
        The sensor does not respond significantly to the mirror.
    """
    noise = float(np.trace(covariance))
    if not noise > 0:
        return
    n_modes = matrix.shape[1]
    ratio = float(np.vdot(matrix @ gram, matrix)) / (n_modes * noise)
    dof = n_modes * noise**2 / float(np.square(covariance).sum())
    chance_ratio = (
        _COLOURED_NOISE_FACTOR * (1 + np.sqrt(lags / dof)) ** 2 * (1 + _MIN_SIGNIFICANCE * np.sqrt(2 / dof))
    )
    if ratio < chance_ratio:
        raise CalibrationError(
            f"the wavefront sensor does not respond to the mirror: the pokes explain {ratio:.2f} times the "
            f"power of the noise, chance alone up to {chance_ratio:.2f}; check that there is light and that "
            "the mirror is in the beam and powered, or use larger pokes or more frames"
        )


def variance_inflation(
    noise: NDArray[np.floating], filtered_commands: NDArray[np.floating], at: NDArray[np.intp], lags: int
) -> float:
    """Factor on the variance of a regression whose noise is not white.

    ``1 + 2 sum over k > 0 of rho_noise(k) rho_poke(k)``, with the autocorrelations of the noise and of the
    pokes through the temporal response: the frames that show a poke have nearly the same turbulence.

    Parameters
    ----------
    noise
        Residual slopes ``(n, n_slopes)``.
    filtered_commands
        Pokes through the temporal response ``(n, n_modes)``.
    at
        Time of each row in frames ``(n,)``, increasing.
    """
    centred = noise - noise.mean(axis=0)
    factor = 1.0
    for lag in range(1, lags):
        now = np.flatnonzero(np.isin(at - lag, at))
        past = np.searchsorted(at, at[now] - lag)
        factor += 2 * _correlation(centred, now, past) * _correlation(filtered_commands, now, past)
    return max(factor, 0.0)


def _correlation(values: NDArray[np.floating], now: NDArray[np.intp], past: NDArray[np.intp]) -> float:
    a, b = values[now], values[past]
    size = float(np.sqrt(np.vdot(a, a) * np.vdot(b, b)))
    return float(np.vdot(a, b)) / size if size > 0 else 0.0


@dataclass(frozen=True, slots=True, eq=False)
class InitialFit:
    """Fit of the first frames.

    ``whitener``: filter over time ``(order + 1,)``; ``variance_inflation``: factor on the variance of an
    estimate whose noise is not white.
    """

    whitener: NDArray[np.float64]
    response: ResponseEstimate
    variance_inflation: float


def create_sums(n_slopes: int, n_modes: int, closed: bool, *, correlations: bool) -> RegressionSums:
    """Empty sums for open or closed loop."""
    if closed:
        return InstrumentalVariableSums.zeros(n_slopes, 2 * n_modes, correlations=correlations)
    return RegressionSums.zeros(n_slopes, n_modes, correlations=correlations)


def fit_first_frames(data: AlignedTelemetry, order: int, lags: int) -> InitialFit | None:
    """Estimate temporal response and whitening filter, first from frame differences, then iteratively.

    Returns ``None`` if there are too few frames.

    Raises
    ------
    CalibrationError
        The pokes do not span the modes, the sensor responds after the last lag, or (without a filter) it does
        not respond.
    """
    if find_usable_rows(data, max(order, 1), lags).size < data.n_modes + lags + MIN_DEGREES_OF_FREEDOM:
        return None
    require_excitation(data.pokes.T @ data.pokes)
    difference = np.array([1.0, -1.0])
    sampled = data.select_slopes(_FILTER_SLOPES if order else RESPONSE_SLOPES)
    response = fit_response(sampled, difference, lags)
    if not order:
        inflation = _estimate_plain_inflation(sampled, difference, response, lags)
        return InitialFit(np.ones(1), response, inflation)
    residuals, usable = _compute_residuals(sampled, difference, response, lags)
    whitener = fit_prediction_error_filter(residuals, usable, order)
    require_no_late_response(data, whitener, lags)
    return InitialFit(whitener, fit_response(data, whitener, lags), 1.0)


def _regress(
    block: FilteredTelemetry, response: ResponseEstimate
) -> tuple[NDArray[np.float32], RegressionSums, NDArray[np.float64]]:
    """Commands through the response (pokes beside them in closed loop), sums and matrix of a block."""
    excitation = block.excitation(response.weights)
    sums = create_sums(block.n_slopes, block.n_modes, block.closed, correlations=False)
    sums = sums.add(block.slopes, excitation).subtract_means()
    return excitation, sums, sums.solve()


def _estimate_plain_inflation(
    sampled: AlignedTelemetry, difference: NDArray[np.float64], response: ResponseEstimate, lags: int
) -> float:
    """Variance inflation of the plain estimator; raises unless the frame differences show a response."""
    block = filter_telemetry(sampled, difference, lags)
    filtered_commands, sums, matrix = _regress(block, response)
    noise, now = block.slopes - filtered_commands @ matrix.T.astype(np.float32), block.now
    covariance = noise.T @ noise / (len(noise) - sampled.n_modes - lags)
    covariance *= variance_inflation(noise, filtered_commands, now, lags)
    require_response(sums.gram, matrix, covariance, lags)
    residuals, usable = _compute_residuals(sampled, difference, response, lags)
    at = np.flatnonzero(usable)
    commands = apply_filter(sampled.rows, response.weights, at, sampled.n_slopes)
    return variance_inflation(residuals[at], commands, at, lags)


def _compute_residuals(
    data: AlignedTelemetry, whitener: NDArray[np.float64], response: ResponseEstimate, lags: int
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Slopes without the response to the commands ``(n_times, n_slopes)``, and a mask of the valid rows."""
    *_, matrix = _regress(filter_telemetry(data, whitener, lags), response)
    at = data.find_complete_rows(0, lags)
    residuals = np.zeros_like(data.slopes)
    filtered_commands = apply_filter(data.rows, response.weights, at, data.n_slopes)[:, : data.n_modes]
    residuals[at] = data.slopes[at] - filtered_commands @ matrix.T.astype(np.float32)
    usable = np.zeros_like(data.present)
    usable[at] = True
    return residuals, usable


def require_excitation(gram: NDArray[np.floating]) -> None:
    """Raise :class:`CalibrationError` unless pokes with this gram matrix span the modes."""
    # The estimated condition takes a twentieth of the time of the eigenvalues.
    size = np.abs(gram).sum(axis=0).max()
    cholesky, failed = lapack.dpotrf(gram)
    if failed or lapack.dpocon(cholesky, size)[0] <= _MIN_RECIPROCAL_CONDITION:
        raise CalibrationError(
            "the pokes do not excite every mode; check that the poke is not zero and not clipped away"
        )


def estimate_preview(
    sums: RegressionSums, tracker: ResponseTracker, variance_inflation: float, lags: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Estimate matrix and standard errors ``(n_slopes, n_modes)`` from sums, which are not changed.

    ``None`` if there are too few frames, or the pokes do not span the modes yet.
    """
    scale = tracker.scale(tracker.response())
    if sums.count < scale.size + lags + MIN_DEGREES_OF_FREEDOM:
        return None
    power = sums.power if sums.power.ndim == 1 else np.diag(sums.power).copy()
    centred_sums = replace(sums, power=power).subtract_means()
    try:
        matrix, unit = centred_sums.solve(), centred_sums.inverse_diagonal()
    except np.linalg.LinAlgError:
        return None
    dof = max(centred_sums.degrees_of_freedom() - lags, 1.0)
    variance = np.maximum(centred_sums.residual_power(matrix) / dof, 0.0)
    sigma = np.outer(np.sqrt(variance * variance_inflation), np.sqrt(np.maximum(unit, 0.0)) * np.abs(scale))
    return matrix * scale, sigma


@dataclass(frozen=True, slots=True, eq=False)
class DocrimeSolution:
    """Solution of a DO-CRIME run.

    Parameters
    ----------
    matrix, sigma
        Slopes per unit mode ``(n_slopes, n_modes)``, and standard errors of its elements, without that of
        their common gain.
    covariance
        Covariance of one frame's filtered residual slopes ``(n_slopes, n_slopes)``; ``None`` if the
        correlations were not summed.
    gram
        Information on the modes ``(n_modes, n_modes)``: inverse covariance of a row of the matrix, per
        variance of its slope's noise; in open loop the sum of filtered pokes times filtered pokes.
    variance
        Variance of each slope's filtered noise, including the variance inflation ``(n_slopes,)``.
    whitener
        Filter ``(order + 1,)``, ``[1]`` for the plain estimator.
    gain_sigma
        Relative standard error of the common gain, by the errors of the temporal response.
    response_covariance
        Covariance of the weights of the response ``(lags, lags)``.
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
    __repr__ = short_repr


def solve_sums(
    raw_sums: RegressionSums,
    tracker: ResponseTracker,
    fit: InitialFit,
    *,
    lags: int,
    frames: int,
    lost_frames: int,
) -> DocrimeSolution:
    """Solve sums for the matrix, its standard errors and the temporal response.

    ``raw_sums``, ``tracker``: sums and temporal response over all filtered frames; not changed; ``fit``: fit
    of the first frames. Without a whitening filter the response is not tested for significance.

    Raises
    ------
    CalibrationError
        The sensor does not respond significantly, or the pokes do not span the modes.
    """
    sums = raw_sums.subtract_means()
    information = sums.information()
    require_excitation(information)
    matrix = sums.solve()
    dof = sums.degrees_of_freedom() - lags
    if fit.whitener.size > 1:
        rows, power = sums.sample(matrix)
        require_response(information, rows, power / dof, lags)
    residual = sums.residual_power(matrix) / dof
    covariance = residual if residual.ndim == 2 else None
    variance = np.maximum(residual if covariance is None else np.diag(residual), 0.0) * fit.variance_inflation
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
        fit.whitener,
        frames,
        lost_frames,
        tracker.gain_sigma(response),
        response.covariance,
    )
