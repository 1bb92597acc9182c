"""SPRINT straight from whitened telemetry, with no interaction matrix in between.

Gain, registration and the few weights of the temporal response are some ten unknowns against a
thousand slopes per frame, so fewer frames than modes are enough. With ``y`` the whitened slopes and
``x`` the whitened pokes as seen through the response, the log-likelihood of ``y = D(g, alpha) x + e``
depends on the frames through ``sum y x^T`` and ``sum x x^T`` alone. Turned onto the eigenvectors of
the second, the first becomes a matrix whose columns have equal and independent noise
(:func:`independent_columns`), one for each direction that the pokes really took; SPRINT fits that.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.matrix import InteractionMatrix
from escape_hw.api.model import SyntheticModel
from escape_hw.api.procedure import Procedure
from escape_hw.api.registration import Registration
from escape_hw.api.results import RegistrationEstimate, TemporalResponse
from escape_hw.calibration.derivatives import modal_matrix
from escape_hw.calibration.docrime import MOST_CORRELATED
from escape_hw.calibration.response import Filtered, filtered
from escape_hw.calibration.sprint import sprint_steps
from escape_hw.calibration.telemetry import Telemetry
from escape_hw.calibration.whitening import apply_filter, prediction_error_filter
from escape_hw.errors import TooFewFrames

#: Rounds of response, whitener and registration; the third changes nothing that matters.
_ROUNDS = 3
#: Directions that the pokes took less than this share of the strongest tell nothing.
_LEAST = 1e-9
#: Whitened frames without which no noise level is worth stating.
MIN_ROWS = 12
#: Whitened frames at which the measured correlation of the slopes' noise counts half.
_CORRELATION_ROWS = 50


@dataclass(frozen=True, slots=True, eq=False)
class TelemetryFit:
    """What the telemetry says.

    Parameters
    ----------
    estimate
        Registration and gain, with errors.
    response
        The temporal response, its weights scaled to sum 1.
    whitener
        The filter over time.
    covariance
        Covariance of one frame's whitened noise ``(n_slopes, n_slopes)``, shrunk towards its diagonal;
        ``None`` with more than :data:`~escape_hw.calibration.docrime.MOST_CORRELATED` slopes.
    rows
        Whitened frames that it rests on.
    """

    estimate: RegistrationEstimate
    response: TemporalResponse
    whitener: NDArray[np.float64]
    covariance: NDArray[np.float64] | None
    rows: int


def independent_columns(
    matrix: InteractionMatrix, gram: NDArray[np.float64], variance: NDArray[np.float64]
) -> InteractionMatrix:
    """A least-squares matrix turned so that its columns have equal, independent noise.

    Parameters
    ----------
    matrix
        ``D = (sum y x^T) (sum x x^T)^+``; fewer frames than modes are allowed.
    gram
        ``sum x x^T`` ``(n_modes, n_modes)``.
    variance
        Variance of each slope's whitened noise in one frame ``(n_slopes,)``.

    Returns
    -------
    InteractionMatrix
        ``(n_slopes, rank)``, with the modes turned alike; its modes have no unit rms any more.
    """
    power, directions = np.linalg.eigh(gram)
    taken = power > _LEAST * power.max()
    turn = directions[:, taken] * np.sqrt(power[taken])
    sigma = np.repeat(np.sqrt(variance)[:, None], turn.shape[1], axis=1)
    return replace(
        matrix,
        data=(matrix.data @ turn).astype(np.float32),
        sigma=sigma.astype(np.float32),
        m2c=matrix.m2c @ turn,
    )


def time_line(
    index: NDArray[np.int64], slopes: NDArray[np.floating], pokes: NDArray[np.floating], before: int
) -> Telemetry:
    """Frames on their time line, after ``before`` rows in which the mirror was flat.

    Parameters
    ----------
    index
        Frame indices ``(n,)``, rising.
    slopes, pokes
        ``(n, n_slopes)`` and ``(n, n_modes)``; each poke was sent after the frame of its row.
    before
        Rows without slopes but with known pokes, of zero, in front.
    """
    at = index - index[0] + before
    n_slopes = slopes.shape[1]
    rows = np.zeros((int(at[-1]) + 1, n_slopes + pokes.shape[1]), np.float32)
    present = np.zeros(len(rows), np.bool_)
    rows[at, :n_slopes], rows[at, n_slopes:], present[at] = slopes, pokes, True
    for lost in np.flatnonzero(~present[before:]) + before:
        # While a frame is lost the last poke stays on the mirror.
        rows[lost, n_slopes:] = rows[lost - 1, n_slopes:]
    return Telemetry(rows, present, n_slopes)


def telemetry_sprint(
    data: Telemetry,
    frame: InteractionMatrix,
    model: SyntheticModel,
    *,
    order: int,
    lags: int,
    start: Registration | None = None,
    learning_rate: float = 1.0,
) -> Procedure[TelemetryFit]:
    """Registration, gain and temporal response from a stretch of telemetry.

    Parameters
    ----------
    data
        From :func:`time_line`, with at least ``2 order + lags`` rows in front.
    frame
        Any matrix of this sensor and basis: its mask, basis and provenance are used, its data are not.
    model
        The synthetic model on the same sub-apertures.
    order
        Past frames that predict the turbulence; 0: nothing is predicted.
    lags
        Frames over which the temporal response is estimated.
    start
        Where to start; from afar by default.
    learning_rate
        As for :func:`~escape_hw.calibration.sprint.sprint`.

    Raises
    ------
    TooFewFrames
        Fewer than :data:`MIN_ROWS` whitened frames; says how many there are.
    CalibrationError
        The slopes do not follow the pokes.
    """
    whitener = np.array([1.0, -1.0]) if order else np.ones(1)
    matrix: NDArray[np.float64] | None = None
    for _ in range(_ROUNDS):
        block = filtered(data, whitener, lags)
        if len(block.now) < MIN_ROWS:
            raise TooFewFrames(
                f"{len(block.now)} whitened frames are too few for a registration; "
                f"at least {MIN_ROWS + order} frames in a row are needed"
            )
        response = _first_response(block, lags) if matrix is None else _response(block, matrix, lags)
        slopes = block.slopes.astype(float)
        seen = block.driven(response.weights).astype(float)
        slopes, seen = slopes - slopes.mean(axis=0), seen - seen.mean(axis=0)
        left = slopes if matrix is None else slopes - seen @ matrix.T
        variance = np.square(left).mean(axis=0)
        covariance = _shrunk(left) if left.shape[1] <= MOST_CORRELATED else None
        gram = seen.T @ seen
        measured = replace(
            frame,
            data=(slopes.T @ seen @ np.linalg.pinv(gram, rcond=_LEAST, hermitian=True)).astype(np.float32),
            sigma=np.zeros(frame.data.shape, np.float32),
        )
        columns = independent_columns(measured, gram, variance)
        estimate = yield from sprint_steps(
            columns, model, start=start, learning_rate=learning_rate, covariance=covariance,
            reach=start is None,
        )  # fmt: skip
        start = estimate.registration
        unit = modal_matrix(model, start, frame.m2c, estimate.width.value)
        matrix = estimate.gain.value * unit
        if order:
            whitener = _whitener(data, matrix, response, order, lags)
    return TelemetryFit(estimate, response, whitener, covariance, len(block.now))


def _first_response(block: Filtered, lags: int) -> TemporalResponse:
    """All weight on the lag at which slopes and pokes go together most."""
    slopes, n = block.slopes, block.n_slopes
    power = [float(np.square(slopes.T @ block.before(lag)[:, n:]).sum()) for lag in range(lags)]
    weights = np.zeros(lags)
    weights[int(np.argmax(power))] = 1.0
    return TemporalResponse(weights, np.ones(lags))


def _response(block: Filtered, matrix: NDArray[np.float64], lags: int) -> TemporalResponse:
    """Weights of the lags from what a matrix predicts, scaled to sum 1, with errors by frames."""
    n = block.n_slopes
    predicted = np.stack([block.before(lag)[:, n:] @ matrix.T for lag in range(lags)])
    slopes = block.slopes.astype(float)
    flat = predicted.reshape(lags, -1)
    bread = np.linalg.inv(flat @ flat.T)
    weights = bread @ (flat @ slopes.ravel())
    left = slopes - np.tensordot(weights, predicted, axes=1)
    # Neighbouring slopes err together, whitened frames do not.
    scores = np.einsum("lts,ts->lt", predicted, left)
    total = float(weights.sum())
    weights = weights / total
    scaled = (np.eye(lags) - weights[:, None]) @ bread / total
    covariance = scaled @ (scores @ scores.T) @ scaled.T
    return TemporalResponse(weights, np.sqrt(np.diag(covariance)))


def _shrunk(residuals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Covariance of the slopes' noise: few frames tell its diagonal, many its correlations too."""
    n = len(residuals)
    covariance = residuals.T @ residuals / n
    share = n / (n + _CORRELATION_ROWS)
    return np.asarray(share * covariance + (1 - share) * np.diag(np.diag(covariance)))


def _whitener(
    data: Telemetry, matrix: NDArray[np.float64], response: TemporalResponse, order: int, lags: int
) -> NDArray[np.float64]:
    """Prediction-error filter of what the pokes do not explain."""
    at = np.arange(lags - 1, data.present.size)
    explained = apply_filter(data.rows, response.weights, at, data.n_slopes) @ matrix.T.astype(np.float32)
    return prediction_error_filter(data.slopes[at] - explained, data.present[at], order)
