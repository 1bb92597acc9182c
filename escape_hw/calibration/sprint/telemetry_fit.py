"""SPRINT directly from whitened telemetry, without an interaction matrix.

Gain, registration and the weights of the temporal response are some ten unknowns against a thousand slopes
per frame, so fewer frames than modes are enough. With ``y`` the whitened slopes and ``x`` the whitened pokes
convolved with the response, the log-likelihood of ``y = D(g, alpha) x + e`` depends on the frames through
``sum y x^T`` and ``sum x x^T`` alone. Rotated to the eigenvectors of the second, the first becomes a matrix
whose columns have equal and independent noise (:func:`decorrelate_columns`), one for each direction of the
pokes; SPRINT fits that matrix.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.procedure import Procedure
from escape_hw.api.registration import Registration
from escape_hw.api.results import RegistrationEstimate, TemporalResponse
from escape_hw.api.synthetic_model import SyntheticModel
from escape_hw.calibration.acquisition.aligned_telemetry import AlignedTelemetry
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
from escape_hw.calibration.sprint.fit import SprintOptions, fit_registration
from escape_hw.errors import TooFewFrames

#: Iterations over registration, response, whitening filter and priors; a fifth changes nothing relevant.
_OPEN_LOOP_ROUNDS = 4
#: The first iteration in closed loop uses the control matrix, whose influence needs two more to vanish.
_CLOSED_LOOP_ROUNDS = 6
#: Smallest number of whitened frames for an estimate of the noise.
MIN_WHITENED_FRAMES = 12
#: Singular values of the pokes, relative to the largest, below which a pattern was not poked.
_MIN_SINGULAR_RATIO = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class TelemetryFit:
    """Result of a fit to telemetry.

    Parameters
    ----------
    estimate
        Registration and gain, with standard errors.
    response
        The temporal response, with weights of sum 1.
    whitener
        The whitening filter, for frames with a complete history.
    covariance
        Covariance of the whitened noise of one frame ``(n_slopes, n_slopes)``; ``None`` with more than
        :data:`~escape_hw.calibration.docrime.regression.MAX_CORRELATED_SLOPES` slopes.
    n_frames
        Number of whitened frames.
    """

    estimate: RegistrationEstimate
    response: TemporalResponse
    whitener: NDArray[np.float64]
    covariance: NDArray[np.float64] | None
    n_frames: int


def decorrelate_columns(
    matrix: InteractionMatrix, gram: NDArray[np.float64], variance: NDArray[np.float64]
) -> InteractionMatrix:
    """Rotate a least-squares matrix so that its columns have equal, independent noise.

    Parameters
    ----------
    matrix
        ``D = (sum y x^T) (sum x x^T)^+``, from any number of frames.
    gram
        ``sum x x^T`` ``(n_modes, n_modes)``.
    variance
        Variance of the whitened noise of each slope in one frame ``(n_slopes,)``.

    Returns
    -------
    InteractionMatrix
        ``(n_slopes, rank)``, with modes rotated likewise, which do not have unit rms.
    """
    return whiten_columns(matrix, matrix.data @ gram, gram, gram, variance)


def telemetry_from_frames(
    index: NDArray[np.int64], slopes: NDArray[np.floating], pokes: NDArray[np.floating], before: int
) -> AlignedTelemetry:
    """Telemetry with a row per frame period, after ``before`` rows with a flat mirror.

    Parameters
    ----------
    index
        Frame indices ``(n,)``, ascending.
    slopes, pokes
        ``(n, n_slopes)`` and ``(n, n_modes)``; each poke was sent after the frame of its row.
    before
        Number of rows in front with zero pokes and without slopes.
    """
    at = index - index[0] + before
    n_slopes = slopes.shape[1]
    rows = np.zeros((int(at[-1]) + 1, n_slopes + pokes.shape[1]), np.float32)
    present = np.zeros(len(rows), np.bool_)
    rows[at, :n_slopes], rows[at, n_slopes:], present[at] = slopes, pokes, True
    for missing in np.flatnonzero(~present[before:]) + before:
        # The mirror keeps the last poke while a frame is lost.
        rows[missing, n_slopes:] = rows[missing - 1, n_slopes:]
    return AlignedTelemetry(rows, present, n_slopes)


def fit_telemetry(
    data: AlignedTelemetry,
    template: InteractionMatrix,
    model: SyntheticModel,
    *,
    order: int,
    lags: int,
    options: SprintOptions,
    start: Registration | None = None,
    known_response: TemporalResponse | None = None,
) -> Procedure[TelemetryFit]:
    """Fit registration, gain and temporal response to telemetry.

    Parameters
    ----------
    data
        Telemetry of an open-loop run from :func:`telemetry_from_frames`, with at least ``2 order + lags``
        rows in front; or of a closed loop, with the commands of as many rows in front.
    template
        A matrix of this sensor and basis, of which mask, basis and provenance are used; in closed loop the
        control matrix, with which the first iteration starts.
    model
        The synthetic model on the same sub-apertures.
    order
        Number of past frames from which the turbulence is predicted; 0: no prediction.
    lags
        Number of frames of the temporal response.
    options
        Options of SPRINT; a solver for matrices only cannot be used.
    start
        Initial registration; by default it is searched from far away.
    known_response
        Temporal response to use while the frames do not determine it better.

    Raises
    ------
    TooFewFrames
        Fewer than :data:`MIN_WHITENED_FRAMES` whitened frames.
    CalibrationError
        The slopes do not follow the pokes.
    """
    filters = [np.ones(1), np.array([1.0, -1.0])][: 2 if order else 1]
    matrix = template.data.astype(np.float64) if data.closed else None
    priors, n_effective_parameters, state = options["usual_priors"], 0.0, None
    rounds = _CLOSED_LOOP_ROUNDS if data.closed else _OPEN_LOOP_ROUNDS
    for number in range(rounds):
        frames = WhitenedFrames.from_telemetry(data, filters, lags)
        n = len(frames.slopes)
        if n < MIN_WHITENED_FRAMES:
            raise TooFewFrames(
                f"{n} whitened frames are too few for a registration; "
                f"at least {MIN_WHITENED_FRAMES + min(order, 1)} frames are needed, most of them in a row"
            )
        slopes = residual = frames.slopes
        if matrix is None:
            response = _initial_response(frames)
        else:
            response = _estimate_response(frames, matrix, known_response)
            residual = slopes - frames.delayed_commands(response.weights) @ matrix.T
        degrees_of_freedom = max(n - 1 - n_effective_parameters / slopes.shape[1], 1.0)
        variance = np.square(residual).sum(axis=0) / degrees_of_freedom
        pure = None if matrix is None else frames.pure_error(response.weights)
        if pure is not None:
            # Misfit of the model included, it would be taken for noise; of single slopes it is better known.
            variance *= float(pure.sum() / variance.sum())
        covariance = residual.T @ residual / n if residual.shape[1] <= MAX_CORRELATED_SLOPES else None
        fit = yield from fit_registration(
            frames.columns(template, response.weights, matrix, variance), model, start=start,
            covariance=covariance, priors=priors, update_priors=False, coarse_search=start is None,
            state=state, check_orientation=number == rounds - 1, **options,
        )  # fmt: skip
        state, start = fit.state, fit.estimate.registration
        matrix = fit.zonal_matrix() @ template.m2c
        if fit.estimate_priors is not None:
            prior_estimate = fit.estimate_priors()
            priors, n_effective_parameters = prior_estimate.priors, prior_estimate.n_effective_parameters
        if order:
            filters = fit_history_filters(*_residual_slopes(data, matrix, response), order)
    estimate = fit.estimate
    if pure is None and estimate.model_fits:
        # The noise is that of the residual of the previous iteration, in which a misfit may be.
        notes = *estimate.notes, _describe_unjudged(data.closed, n, template.n_modes)
        estimate = replace(estimate, goodness_of_fit=None, notes=notes)
    return TelemetryFit(estimate, response, filters[-1], covariance, n)


def _describe_unjudged(closed: bool, n_frames: int, n_modes: int) -> str:
    """Note on a fit that is not judged, because its own residual is all that is known of the noise."""
    unjudged = "whether the model fits to within the noise is not judged"
    if closed:
        return f"{unjudged}: the commands of a closed loop follow the noise"
    return (
        f"{unjudged}: {n_frames} frames after whitening are too few for {n_modes} modes, "
        f"{n_modes + 1 + MIN_WHITENED_FRAMES} are enough"
    )


@dataclass(frozen=True, slots=True, eq=False)
class WhitenedFrames:
    """Whitened slopes ``(n, n_slopes)``, commands and pokes by lag ``(lags, n, n_modes)``, without means.

    In open loop the commands are the pokes.
    """

    slopes: NDArray[np.float64]
    commands: NDArray[np.float64]
    pokes: NDArray[np.float64]

    @classmethod
    def from_telemetry(
        cls, data: AlignedTelemetry, filters: list[NDArray[np.float64]], lags: int
    ) -> WhitenedFrames:
        """Whiten telemetry by filters of rising order, and delay commands and pokes by each lag."""
        past = count_known_history(data.present, len(filters) - 1)
        # The mean slopes are unknown: project out a constant, filtered as the slopes are.
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
        """Commands convolved with the response ``(n, n_modes)``."""
        return np.asarray(np.tensordot(response, self.commands, axes=1))

    def pure_error(self, response: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Variance of each slope about a least-squares matrix ``(n_slopes,)``, which no model fits worse.

        ``None`` in closed loop, where the commands follow the slopes, and with fewer than
        :data:`MIN_WHITENED_FRAMES` frames more than such a matrix has unknowns per slope.
        """
        if self.commands is not self.pokes:
            return None
        patterns, values, _ = np.linalg.svd(self.delayed_commands(response), full_matrices=False)
        patterns = patterns[:, values > _MIN_SINGULAR_RATIO * values[0]]
        # One more for the mean.
        degrees_of_freedom = len(self.slopes) - 1 - patterns.shape[1]
        if degrees_of_freedom < MIN_WHITENED_FRAMES:
            return None
        residual = self.slopes - patterns @ (patterns.T @ self.slopes)
        return np.asarray(np.square(residual).sum(axis=0) / degrees_of_freedom)

    def columns(
        self,
        template: InteractionMatrix,
        response: NDArray[np.float64],
        matrix: NDArray[np.float64] | None,
        variance: NDArray[np.float64],
    ) -> InteractionMatrix:
        """Sufficient statistics of the frames as a matrix whose columns have equal, independent noise.

        In closed loop the pokes are the instruments of the commands, and the contribution of the
        controller, predicted with ``matrix``, is subtracted first
        (:mod:`~escape_hw.calibration.docrime.regression`).
        """
        poked = np.tensordot(response, self.pokes, axes=1)
        sums = InstrumentalEquations.from_rows(self.slopes, self.delayed_commands(response), poked)
        cross = sums.cross
        if matrix is not None and self.commands is not self.pokes:
            cross = sums.poke_response(matrix)
        return whiten_columns(template, cross, sums.poke_products, sums.poke_products, variance)


def delay_rows(pokes: NDArray[np.floating], lag: int) -> NDArray[np.floating]:
    """Pokes ``lag`` rows later, after a flat mirror."""
    return np.concatenate([np.zeros_like(pokes[:lag]), pokes[: len(pokes) - lag]])


def _residual_slopes(
    data: AlignedTelemetry, matrix: NDArray[np.float64], response: TemporalResponse
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Slopes minus the prediction of a matrix ``(n_times, n_slopes)``, and the rows present."""
    delayed_commands = sum(
        weight * delay_rows(data.commands, lag) for lag, weight in enumerate(response.weights)
    )
    residual = data.slopes - np.asarray(delayed_commands) @ matrix.T
    return (residual - residual[data.present].mean(axis=0)).astype(np.float32), data.present


def _initial_response(frames: WhitenedFrames) -> TemporalResponse:
    """A response of one lag, that of the largest correlation of slopes and pokes."""
    power = [float(np.square(frames.slopes.T @ pokes).sum()) for pokes in frames.pokes]
    weights = np.zeros(len(power))
    weights[int(np.argmax(power))] = 1.0
    return TemporalResponse(weights, np.ones(len(power)))


def _estimate_response(
    frames: WhitenedFrames, matrix: NDArray[np.float64], known: TemporalResponse | None
) -> TemporalResponse:
    """Weights of the lags, scaled to sum 1, with errors from the scatter over frames.

    In closed loop the slopes predicted from the pokes are the instruments of those predicted from the
    commands. A known response is kept while its errors are smaller and the data do not contradict it.
    """
    predicted = frames.commands @ matrix.T
    poked = predicted if frames.commands is frames.pokes else frames.pokes @ matrix.T
    lags = len(predicted)
    flat, by_pokes = predicted.reshape(lags, -1), poked.reshape(lags, -1)
    bread = np.linalg.inv(by_pokes @ flat.T)
    weights = bread @ (by_pokes @ frames.slopes.ravel())
    residual = frames.slopes - np.tensordot(weights, predicted, axes=1)
    # The noise is correlated over slopes and independent over whitened frames.
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
    """Fit the prediction-error filter of the residual slopes.

    Parameters
    ----------
    data
        Slopes and pokes, or in closed loop total commands.
    matrix, response
        Interaction matrix ``(n_slopes, n_modes)`` and temporal response.
    order, lags
        Past frames of the filter, and frames of the response.
    """
    at = np.arange(lags - 1, data.present.size)
    commands = apply_filter(data.rows, response.weights, at, data.n_slopes)
    predicted_slopes = commands @ matrix.T.astype(np.float32)
    return fit_prediction_error_filter(data.slopes[at] - predicted_slopes, data.present[at], order)
