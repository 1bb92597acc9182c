"""What DO-CRIME finds on the first frames, before its sums begin: temporal response and filter."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from escape_hw.calibration.lag_sums import ResponseEstimate
from escape_hw.calibration.late_response import require_whole_response
from escape_hw.calibration.regression import InstrumentSums, RegressionSums
from escape_hw.calibration.response import SLOPES, Filtered, filtered, fit_response, usable_rows
from escape_hw.calibration.significance import require_response, spread
from escape_hw.calibration.telemetry import Telemetry
from escape_hw.calibration.whitening import apply_filter, prediction_error_filter
from escape_hw.errors import CalibrationError

#: Degrees of freedom without which no standard error is worth stating.
MIN_FREEDOM = 20
#: Slopes that the filter, common to all, is found from.
_FEW_SLOPES = 32


@dataclass(frozen=True, slots=True, eq=False)
class FirstFit:
    """What the first frames say.

    Parameters
    ----------
    whitener
        Filter over time ``(order + 1,)``.
    response
        The temporal response.
    spread
        Factor on the variance of an estimate whose noise is not white.
    """

    whitener: NDArray[np.float64]
    response: ResponseEstimate
    spread: float


def empty_sums(n_slopes: int, n_modes: int, closed: bool, *, correlations: bool) -> RegressionSums:
    """Sums for open or closed loop."""
    if closed:
        return InstrumentSums.zeros(n_slopes, 2 * n_modes, correlations=correlations)
    return RegressionSums.zeros(n_slopes, n_modes, correlations=correlations)


def first_fit(data: Telemetry, order: int, lags: int) -> FirstFit | None:
    """Temporal response and filter from the first frames: by frame differences, then by the filter.

    Parameters
    ----------
    data
        The frames so far.
    order
        Past frames that predict the turbulence; 0 finds the response alone.
    lags
        Frames over which the temporal response is estimated.

    Returns
    -------
    FirstFit or None
        ``None``: too few frames.

    Raises
    ------
    CalibrationError
        The pokes do not span the modes, the response goes on after its last lag, or (plain estimator)
        the mirror does not respond.
    """
    if usable_rows(data, max(order, 1), lags).size < data.n_modes + lags + MIN_FREEDOM:
        return None
    require_excitation(data.pokes.T @ data.pokes)
    # Differences tell the response well even where the plain estimator is asked for.
    difference, few = np.array([1.0, -1.0]), data.thinned(_FEW_SLOPES if order else SLOPES)
    response = fit_response(few, difference, lags)
    if not order:
        return FirstFit(np.ones(1), response, _plain_spread(few, difference, response, lags))
    residuals, usable = _residuals(few, difference, response, lags)
    whitener = prediction_error_filter(residuals, usable, order)
    require_whole_response(data, whitener, lags)
    return FirstFit(whitener, fit_response(data, whitener, lags), 1.0)


def _regressed(
    block: Filtered, response: ResponseEstimate
) -> tuple[NDArray[np.float32], RegressionSums, NDArray[np.float64]]:
    """Commands as the slopes saw them (pokes beside them in closed loop), sums and matrix of a block."""
    driven = block.driven(response.weights)
    sums = empty_sums(block.n_slopes, block.n_modes, block.closed, correlations=False)
    sums = sums.add(block.slopes, driven).centred()
    return driven, sums, sums.solve()


def _plain_spread(
    few: Telemetry, difference: NDArray[np.float64], response: ResponseEstimate, lags: int
) -> float:
    """Factor on the plain estimator's variance; the differences must show that there is a response."""
    block = filtered(few, difference, lags)
    seen, sums, matrix = _regressed(block, response)
    left, now = block.slopes - seen @ matrix.T.astype(np.float32), block.now
    covariance = left.T @ left / (len(left) - few.n_modes - lags)
    require_response(sums.gram, matrix, covariance * spread(left, seen, now, lags), lags)
    residuals, usable = _residuals(few, difference, response, lags)
    at = np.flatnonzero(usable)
    return spread(residuals[at], apply_filter(few.rows, response.weights, at, few.n_slopes), at, lags)


def _residuals(
    data: Telemetry, whitener: NDArray[np.float64], response: ResponseEstimate, lags: int
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Slopes less what the commands explain ``(n_times, n_slopes)``, and the rows where that is known."""
    *_, matrix = _regressed(filtered(data, whitener, lags), response)
    at = data.complete(0, lags)
    residuals = np.zeros_like(data.slopes)
    seen = apply_filter(data.rows, response.weights, at, data.n_slopes)[:, : data.n_modes]
    residuals[at] = data.slopes[at] - seen @ matrix.T.astype(np.float32)
    usable = np.zeros_like(data.present)
    usable[at] = True
    return residuals, usable


def require_excitation(gram: NDArray[np.floating]) -> None:
    """Raise :class:`CalibrationError` unless pokes with these sums of squares span the modes."""
    # Factor and estimated condition: a twentieth of the time of the eigenvalues.
    size = np.abs(gram).sum(axis=0).max()
    factor, failed = lapack.dpotrf(gram)
    if failed or lapack.dpocon(factor, size)[0] <= 1e-7:
        raise CalibrationError(
            "the pokes do not excite every mode; check that the poke is not zero and not clipped away"
        )


def quick_look(
    sums: RegressionSums, scale: NDArray[np.float64], lags: int, spread: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Matrix and standard errors ``(n_slopes, n_modes)`` without tests, correlations or a change of the sums.

    Parameters
    ----------
    sums
        Of a run that goes on.
    scale
        Factors on the columns ``(n_modes,)``.
    lags, spread
        Frames of the temporal response, and factor on the variance.

    Returns
    -------
    tuple or None
        ``None``: too few frames, or pokes that do not span the modes yet.
    """
    if sums.count < scale.size + lags + MIN_FREEDOM:
        return None
    power = sums.power if sums.power.ndim == 1 else np.diag(sums.power).copy()
    about = replace(sums, power=power).centred()
    try:
        matrix, unit = about.solve(), about.inverse_diagonal()
    except np.linalg.LinAlgError:
        return None
    variance = np.maximum(about.residual_power(matrix) / max(about.freedom() - lags, 1.0), 0.0)
    sigma = np.outer(np.sqrt(variance * spread), np.sqrt(np.maximum(unit, 0.0)) * np.abs(scale))
    return matrix * scale, sigma
