"""SPRINT straight from whitened telemetry, with no interaction matrix in between.

Gain, registration and the few weights of the temporal response are some ten unknowns against a
thousand slopes per frame, so fewer frames than modes are enough. With ``y`` the whitened slopes and
``x`` the whitened pokes as seen through the response, the log-likelihood of ``y = D(g, alpha) x + e``
depends on the frames through ``sum y x^T`` and ``sum x x^T`` alone. Turned onto the eigenvectors of
the second, the first becomes a matrix whose columns have equal and independent noise
(:func:`decorrelate_columns`), one for each direction that the pokes really took; SPRINT fits that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.procedure import Procedure
from escape_hw.api.registration import Registration
from escape_hw.api.results import RegistrationEstimate, TemporalResponse
from escape_hw.api.synthetic_model import SyntheticModel
from escape_hw.calibration.acquisition.telemetry import AlignedTelemetry
from escape_hw.calibration.docrime.regression import (
    MAX_CORRELATED_SLOPES,
    InstrumentalEquations,
    whiten_columns,
)
from escape_hw.calibration.docrime.response import select_response
from escape_hw.calibration.docrime.whitening import (
    apply_filter,
    apply_history_filters,
    count_known_history,
    fit_history_filters,
    fit_prediction_error_filter,
)
from escape_hw.calibration.sprint.fit import fit_registration
from escape_hw.calibration.sprint.normal_equations import Priors
from escape_hw.config.choices import ActuatorModel, ExtraParameter, Loss, Solver
from escape_hw.errors import TooFewFrames

#: Rounds of registration, response, whitener and scatter; a fifth changes nothing that matters.
_OPEN_LOOP_ROUNDS = 4
#: In closed loop the matrix that closes it stands behind the first round, and has to be forgotten.
_CLOSED_LOOP_ROUNDS = 6
#: Whitened frames without which no noise level is worth stating.
MIN_WHITENED_FRAMES = 12
#: By how much more the scalings of short runs come out wrong alike on all plants, times the frames [%]: found
#: over random plants on a twin with all imperfections, like the floor (docs/decisions).
_SHORT_RUN_SIGMA = np.array([0.0, 0.0, 0.0, 0.8, 0.8])


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
        The filter over time, for frames with a full past.
    covariance
        Covariance of one frame's whitened noise ``(n_slopes, n_slopes)``;
        ``None`` with more than :data:`~escape_hw.calibration.docrime.regression.MAX_CORRELATED_SLOPES` slopes.
    rows
        Whitened frames that it rests on.
    """

    estimate: RegistrationEstimate
    response: TemporalResponse
    whitener: NDArray[np.float64]
    covariance: NDArray[np.float64] | None
    rows: int


def decorrelate_columns(
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
    return whiten_columns(matrix, matrix.data @ gram, gram, gram, variance)


def telemetry_from_frames(
    index: NDArray[np.int64], slopes: NDArray[np.floating], pokes: NDArray[np.floating], before: int
) -> AlignedTelemetry:
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
    for missing in np.flatnonzero(~present[before:]) + before:
        # While a frame is lost the last poke stays on the mirror.
        rows[missing, n_slopes:] = rows[missing - 1, n_slopes:]
    return AlignedTelemetry(rows, present, n_slopes)


def fit_telemetry(
    data: AlignedTelemetry,
    template: InteractionMatrix,
    model: SyntheticModel,
    *,
    order: int,
    lags: int,
    start: Registration | None = None,
    known: TemporalResponse | None = None,
    learning_rate: float = 1.0,
    solver: Solver = "mixed-effects",
    loss: Loss = "squares",
    also: Sequence[ExtraParameter] = (),
    actuators: ActuatorModel = "fitted",
) -> Procedure[TelemetryFit]:
    """Registration, gain and temporal response from a stretch of telemetry.

    Parameters
    ----------
    data
        From :func:`telemetry_from_frames`, with at least ``2 order + lags`` rows in front; or of a closed loop, with
        the commands of as many rows in front.
    frame
        A matrix of this sensor and basis: its mask, basis and provenance are used. Its data are used in
        closed loop alone, where they are the one that closes it.
    model
        The synthetic model on the same sub-apertures.
    order
        Past frames that predict the turbulence, for frames that have so many before them; 0: nothing is
        predicted.
    lags
        Frames over which the temporal response is estimated.
    start
        Where to start; from afar by default.
    known
        A temporal response to go on with for as long as the frames tell it no better.
    learning_rate, solver, loss, also, actuators
        As for :func:`~escape_hw.calibration.sprint.fit.sprint`; a solver that needs modes will not do.

    Raises
    ------
    TooFewFrames
        Fewer than :data:`MIN_WHITENED_FRAMES` whitened frames; says how many there are.
    CalibrationError
        The slopes do not follow the pokes.
    """
    filters = [np.ones(1), np.array([1.0, -1.0])][: 2 if order else 1]
    matrix = template.data.astype(np.float64) if data.closed else None
    priors, n_effective_parameters = Priors(), 0.0
    rounds = _CLOSED_LOOP_ROUNDS if data.closed else _OPEN_LOOP_ROUNDS
    for number in range(rounds):
        frames = _WhitenedFrames.of(data, filters, lags)
        n = len(frames.slopes)
        if n < MIN_WHITENED_FRAMES:
            raise TooFewFrames(
                f"{n} whitened frames are too few for a registration; "
                f"at least {MIN_WHITENED_FRAMES + min(order, 1)} frames are needed, most of them in a row"
            )
        response = _initial_response(frames) if matrix is None else _estimate_response(frames, matrix, known)
        slopes = frames.slopes
        residual = slopes if matrix is None else slopes - frames.delayed_commands(response.weights) @ matrix.T
        degrees_of_freedom = max(n - 1 - n_effective_parameters / slopes.shape[1], 1.0)
        variance = np.square(residual).sum(axis=0) / degrees_of_freedom
        covariance = residual.T @ residual / n if residual.shape[1] <= MAX_CORRELATED_SLOPES else None
        fit = yield from fit_registration(
            frames.columns(template, response.weights, matrix, variance), model,
            solver=solver, loss=loss, start=start, learning_rate=learning_rate,
            covariance=covariance, priors=priors, coarse_search=start is None, also=also,
            # Single actuators are looked for once, in the end.
            actuators=actuators if number == rounds - 1 else "nominal",
        )  # fmt: skip
        start = fit.estimate.registration
        matrix = fit.zonal_matrix() @ template.m2c
        if fit.estimate_priors is not None:
            estimate_priors = fit.estimate_priors()
            priors, n_effective_parameters = estimate_priors.priors, estimate_priors.n_effective_parameters
        if order:
            filters = fit_history_filters(*_residual_slopes(data, matrix, response), order)
    estimate = fit.estimate
    estimate = replace(estimate, covariance=estimate.covariance + np.diag(np.square(_SHORT_RUN_SIGMA / n)))
    return TelemetryFit(estimate, response, filters[-1], covariance, n)


@dataclass(frozen=True, slots=True, eq=False)
class _WhitenedFrames:
    """Whitened slopes ``(n, n_slopes)``, commands and pokes by lag ``(lags, n, n_modes)``, without constants.

    In open loop the commands are the pokes.
    """

    slopes: NDArray[np.float64]
    commands: NDArray[np.float64]
    pokes: NDArray[np.float64]

    @classmethod
    def of(cls, data: AlignedTelemetry, filters: list[NDArray[np.float64]], lags: int) -> _WhitenedFrames:
        past = count_known_history(data.present, len(filters) - 1)
        # Wherever the spots rest, nobody poked them there: a constant is free, filtered as the slopes are.
        constant = apply_history_filters(np.ones((past.size, 1)), filters, past)
        constant /= max(float(np.linalg.norm(constant)), 1e-12)

        def whiten(values: NDArray[np.floating]) -> NDArray[np.float64]:
            rows = apply_history_filters(values, filters, past)
            return np.asarray(rows - constant @ (constant.T @ rows))

        def by_lag(values: NDArray[np.floating]) -> NDArray[np.float64]:
            return np.stack([whiten(delay_rows(values, lag)) for lag in range(lags)])

        commands = by_lag(data.commands)
        return cls(whiten(data.slopes), commands, by_lag(data.pokes) if data.closed else commands)

    def delayed_commands(self, response: NDArray[np.float64]) -> NDArray[np.float64]:
        """Commands as the slopes saw them ``(n, n_modes)``."""
        return np.asarray(np.tensordot(response, self.commands, axes=1))

    def columns(
        self,
        template: InteractionMatrix,
        response: NDArray[np.float64],
        matrix: NDArray[np.float64] | None,
        variance: NDArray[np.float64],
    ) -> InteractionMatrix:
        """What the frames say of the matrix, in columns with equal and independent noise.

        In closed loop the pokes are the instruments of the commands, and what the best matrix makes of
        the controller's part is taken out beforehand (:mod:`~escape_hw.calibration.docrime.regression`).
        """
        poked = np.tensordot(response, self.pokes, axes=1)
        sums = InstrumentalEquations.from_rows(self.slopes, self.delayed_commands(response), poked)
        cross = sums.cross
        if matrix is not None and self.commands is not self.pokes:
            cross = sums.poke_response(matrix)
        return whiten_columns(template, cross, sums.poke_products, sums.poke_products, variance)


def delay_rows(pokes: NDArray[np.floating], lag: int) -> NDArray[np.floating]:
    """Pokes ``lag`` rows later; before the first the mirror was flat."""
    return np.concatenate([np.zeros_like(pokes[:lag]), pokes[: len(pokes) - lag]])


def _residual_slopes(
    data: AlignedTelemetry, matrix: NDArray[np.float64], response: TemporalResponse
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """What a matrix leaves of the slopes ``(n_times, n_slopes)``, and which rows are there."""
    delayed_commands = sum(
        weight * delay_rows(data.commands, lag) for lag, weight in enumerate(response.weights)
    )
    residual = data.slopes - np.asarray(delayed_commands) @ matrix.T
    return (residual - residual[data.present].mean(axis=0)).astype(np.float32), data.present


def _initial_response(frames: _WhitenedFrames) -> TemporalResponse:
    """All weight on the lag at which slopes and pokes go together most."""
    power = [float(np.square(frames.slopes.T @ pokes).sum()) for pokes in frames.pokes]
    weights = np.zeros(len(power))
    weights[int(np.argmax(power))] = 1.0
    return TemporalResponse(weights, np.ones(len(power)))


def _estimate_response(
    frames: _WhitenedFrames, matrix: NDArray[np.float64], known: TemporalResponse | None
) -> TemporalResponse:
    """Weights of the lags from what a matrix predicts, scaled to sum 1, with errors by frames.

    In closed loop what the pokes alone make are the instruments of what the commands make. A known
    response stays while its errors are smaller and nothing speaks against it.
    """
    predicted = frames.commands @ matrix.T
    poked = predicted if frames.commands is frames.pokes else frames.pokes @ matrix.T
    lags = len(predicted)
    flat, by_pokes = predicted.reshape(lags, -1), poked.reshape(lags, -1)
    bread = np.linalg.inv(by_pokes @ flat.T)
    weights = bread @ (by_pokes @ frames.slopes.ravel())
    residual = frames.slopes - np.tensordot(weights, predicted, axes=1)
    # Neighbouring slopes err together, whitened frames do not.
    scores = np.einsum("lts,ts->lt", poked, residual)
    total = float(weights.sum())
    weights = weights / total
    scaled = (np.eye(lags) - weights[:, None]) @ bread / total
    covariance = scaled @ (scores @ scores.T) @ scaled.T
    measured = TemporalResponse(weights, np.sqrt(np.diag(covariance)))
    return select_response(measured, known)


def fit_whitener(
    data: AlignedTelemetry, matrix: NDArray[np.float64], response: TemporalResponse, order: int, lags: int
) -> NDArray[np.float64]:
    """Prediction-error filter of what the pokes do not explain.

    Parameters
    ----------
    data
        Slopes and pokes (or, in closed loop, total commands).
    matrix
        ``(n_slopes, n_modes)``.
    response
        Temporal response.
    order, lags
        Past frames that the filter uses, and frames of the response.
    """
    at = np.arange(lags - 1, data.present.size)
    predicted_slopes = apply_filter(data.rows, response.weights, at, data.n_slopes) @ matrix.T.astype(
        np.float32
    )
    return fit_prediction_error_filter(data.slopes[at] - predicted_slopes, data.present[at], order)
