"""Temporal response of mirror and sensor: weight per frame of lag, and from it the loop delay.

With slopes ``y``, predictions ``x`` from a matrix and the commands, and predictions ``z`` from the matrix and
the pokes, the weights of the lags solve ``sum_t z_l(t) (y(t) - sum_k w_k x_k(t)) = 0`` (Söderström & Stoica
1983). They are scaled to sum 1; the rest is the gain of the matrix.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import toeplitz

from escape_hw.api.results import TemporalResponse
from escape_hw.calibration.acquisition.aligned_telemetry import AlignedTelemetry, TelemetryRows
from escape_hw.calibration.docrime.regression import N_SAMPLED_SLOPES, InstrumentalEquations, sampling_step
from escape_hw.calibration.docrime.whitening import apply_filter
from escape_hw.errors import CalibrationError

#: Relative singular value below which a direction is not measured, in single precision.
_RCOND = 1e-7
#: Number of evenly spaced slopes from which the response is estimated.
RESPONSE_SLOPES = N_SAMPLED_SLOPES
#: Least share of a matrix's power that is taken for signal.
_MIN_SIGNAL_FRACTION = 0.01
#: Damping of a provisional matrix, since half of a short run may hold fewer frames than modes.
_DAMPING = 1e-2
#: Frames per lag from which the errors of later frames' weights are known.
_MIN_FRAMES_PER_LAG = 40
#: Frames beyond the lags in which a late response is searched.
_EXTRA_LAGS = 8
#: Standard errors and share of the response from which on a late response is significant.
_MIN_SIGNIFICANCE, _MIN_FRACTION = 6.0, 0.25
#: Standard errors by which two responses must differ, and the difference of a weight that is always allowed.
_MAX_DIFFERENCE_SIGMA, _NEGLIGIBLE_DIFFERENCE = 6.0, 0.05


@dataclass(frozen=True, slots=True, eq=False)
class ResponseEstimate:
    """A temporal response: weights ``(lags,)`` of sum 1, and their covariance ``(lags, lags)``."""

    weights: NDArray[np.float64]
    covariance: NDArray[np.float64]

    @property
    def response(self) -> TemporalResponse:
        """The response with standard errors instead of the covariance."""
        return TemporalResponse(self.weights, np.sqrt(np.maximum(np.diag(self.covariance), 0.0)))

    def combine_with(self, other: ResponseEstimate) -> ResponseEstimate:
        """Mean of two independent estimates, weighted by their covariances."""
        inverse_sum = np.linalg.pinv(self.covariance + other.covariance, rcond=_RCOND, hermitian=True)
        weight = self.covariance @ inverse_sum
        covariance = self.covariance - weight @ self.covariance
        return ResponseEstimate(
            self.weights + weight @ (other.weights - self.weights), (covariance + covariance.T) / 2
        )


class LagSums:
    """Sums over frames for the weights of the lags and their covariance; see the module.

    The products ``z_l y`` and ``z_l x_k`` of each frame are summed, and also the products of these with each
    other. The latter give the covariance of the scores for any weights (White 1980), with errors that are
    correlated between slopes and independent between frames.
    """

    def __init__(self, lags: int) -> None:
        self._lags, size = lags, lags * (lags + 1)
        self._products, self._score_products = np.zeros(size), np.zeros((size, size))
        self._frames = np.zeros(1)

    def add(
        self, slopes: NDArray[np.float32], predicted: NDArray[np.float32], instrument: NDArray[np.float32]
    ) -> Self:
        """Add frames: slopes ``(n, n_slopes)``, predictions and instruments ``(n, lags, n_slopes)``.

        All arrays are centred, and all predictions have one scale.
        """
        regressors = np.concatenate([slopes[:, None], predicted], axis=1).transpose(0, 2, 1)
        products = np.matmul(instrument, regressors).reshape(len(slopes), -1).astype(np.float64)
        self._products += products.sum(axis=0)
        self._score_products += products.T @ products
        self._frames += len(slopes)
        return self

    def merge(self, other: LagSums) -> Self:
        """Add the sums of other frames."""
        for name, array in self.arrays().items():
            array += other.arrays()[name]
        return self

    def scale_covariance(self, factor: float) -> Self:
        """Multiply the covariance of the scores, for frames with dependent errors."""
        self._score_products *= factor
        return self

    def arrays(self) -> dict[str, NDArray[np.float64]]:
        """The arrays of the sums by name; views, through which they can be restored."""
        return {"products": self._products, "squares": self._score_products, "frames": self._frames}

    @property
    def count(self) -> int:
        """Number of frames."""
        return int(self._frames[0])

    def weights(self) -> NDArray[np.float64]:
        """Weights of the lags, not scaled ``(lags,)``."""
        right_hand_side, bread = self._solve_normal_equations()
        return np.asarray(bread @ right_hand_side)

    def response(self) -> ResponseEstimate:
        """The weights scaled to sum 1."""
        right_hand_side, bread = self._solve_normal_equations()
        weights = bread @ right_hand_side
        total = weights.sum()
        score = np.kron(np.eye(self._lags), np.concatenate([[1.0], -weights]))
        # d(w / sum) = (1 - w 1^T) dw / sum.
        scaled = (np.eye(self._lags) - (weights / total)[:, None]) @ bread @ score / total
        return ResponseEstimate(weights / total, scaled @ self._score_products @ scaled.T)

    def _solve_normal_equations(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Right-hand side and inverse of the normal equations."""
        table = self._products.reshape(self._lags, self._lags + 1)
        return table[:, 0], np.asarray(np.linalg.pinv(table[:, 1:], rcond=_RCOND))


@dataclass(frozen=True, slots=True, eq=False)
class FilteredTelemetry(TelemetryRows):
    """Slopes, commands and pokes filtered over time ``(n_rows, ...)``.

    ``now (n,)``, increasing, are the usable rows: their slopes and their commands of all lags are known.
    """

    rows: NDArray[np.float32]
    now: NDArray[np.intp]
    n_slopes: int
    closed: bool

    @property
    def slopes(self) -> NDArray[np.float32]:
        """Slopes of the usable rows ``(n, n_slopes)``."""
        return shift_rows(self.rows, self.now, 0)[:, : self.n_slopes]

    def excitation(self, response: NDArray[np.float64]) -> NDArray[np.float32]:
        """Commands through a response at the usable rows ``(n, n_modes)``; in closed loop also pokes."""
        return apply_filter(self.rows, response, self.now, self.n_slopes)


def shift_rows(rows: NDArray[np.float32], now: NDArray[np.intp], lag: int) -> NDArray[np.float32]:
    """``rows[now - lag]``; a view if ``now`` is contiguous."""
    if now.size and now[-1] - now[0] + 1 == now.size:
        return rows[now[0] - lag : now[-1] - lag + 1]
    return rows[now - lag]


def find_usable_rows(data: AlignedTelemetry, order: int, lags: int) -> NDArray[np.intp]:
    """Rows whose filtered slopes and whose filtered commands of all lags are known."""
    return data.find_complete_rows(order, lags + order)


def filter_telemetry(
    data: AlignedTelemetry, whitener: NDArray[np.float64], lags: int, start: int = 0
) -> FilteredTelemetry:
    """Filter slopes, commands and pokes over time.

    Parameters
    ----------
    whitener
        Filter ``(order + 1,)``.
    lags
        Number of lags whose commands must be known.
    start
        First row whose slopes are needed.
    """
    order = whitener.size - 1
    at = find_usable_rows(data, order, lags)
    at = at[np.searchsorted(at, start) :]
    first = max(start - lags, order)
    rows = apply_filter(data.rows, whitener, np.arange(first, data.present.size))
    return FilteredTelemetry(rows, at - first, data.n_slopes, data.closed)


def compute_lag_covariances(data: FilteredTelemetry, lags: int) -> NDArray[np.float64]:
    """Sums of the filtered commands at lag ``l`` times the filtered pokes at lag ``k``.

    Returns
    -------
    ndarray, ``(1, lags, lags)`` or ``(n_modes, lags, lags)``
        Element ``[., l, k]``. In open loop the pokes of all modes have the same spectrum; in closed loop the
        controller gives each mode its own.
    """
    commands = np.stack([shift_rows(data.commands, data.now, lag) for lag in range(lags)])
    if not data.closed:
        flat = commands.reshape(lags, -1)
        first = (flat[0] @ flat.T).astype(np.float64)
        return np.asarray(toeplitz(first)[None])
    pokes = np.stack([shift_rows(data.pokes, data.now, lag) for lag in range(lags)])
    products = np.einsum("ltm,ktm->mlk", commands, pokes, optimize=True)
    return np.asarray(products.astype(np.float64))


def fit_response(data: AlignedTelemetry, whitener: NDArray[np.float64], lags: int) -> ResponseEstimate:
    """Estimate the share of the response in each of the frames after a command.

    All slopes respond with the same weights, so the weights are regressed on the predictions of a provisional
    matrix. Fitted to the same frames, the noise of that matrix would be taken for a response at neighbouring
    lags. The frames are therefore cut in half, and the matrix of one half predicts the other. Its noise then
    scales all weights alike, and they are scaled to sum 1. In closed loop the pokes are the instruments of
    the commands, for the matrix and for the weights.

    The errors of the result allow for correlations between slopes.
    """
    sums = LagSums(lags)
    for part in fit_halves(filter_telemetry(data.select_slopes(RESPONSE_SLOPES), whitener, lags), lags):
        sums.merge(part.sums)
    return sums.response()


def predict_slopes(
    data: FilteredTelemetry, matrix: NDArray[np.float32], power: NDArray[np.float64]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Predict the slopes from commands and from pokes with a noisy matrix.

    With ``c`` the power of the response to the pokes without the noise of the matrix and ``v`` that with it,
    ``sqrt(c) / v`` is the best weight of the predictions from the pokes. In closed loop, where the commands
    of each mode have their own spectrum, noisy modes would weigh too much and bias the lags. There each mode
    is shrunk by the ratio of its power without and with noise.

    ``matrix``: matrix whose errors are independent of the noise of these frames ``(n_modes, n_slopes)``;
    ``power``: sum of squares of each mode's column without its noise ``(n_modes,)``.

    Returns
    -------
    predicted, instrument : ndarray
        Predictions from commands and from pokes for all rows ``(n_rows, n_slopes)``, centred; the same array
        in open loop.
    """
    noisy_power = np.square(matrix, dtype=np.float64).sum(axis=1)
    poke_power = np.mean(np.square(data.pokes), axis=0, dtype=np.float64)
    total_power = max(float(poke_power @ noisy_power), float(np.finfo(np.float32).tiny))
    size = np.sqrt(max(float(poke_power @ power) / total_power, _MIN_SIGNAL_FRACTION) / total_power)
    instrument = data.pokes @ (matrix * np.float32(size))
    instrument -= instrument.mean(axis=0)
    if not data.closed:
        return instrument, instrument
    mode_weights = power / np.maximum(noisy_power, np.finfo(np.float32).tiny) / (size * total_power)
    predicted = data.commands @ (matrix * mode_weights[:, None]).astype(np.float32)
    predicted -= predicted.mean(axis=0)
    return predicted, instrument


@dataclass(frozen=True, slots=True, eq=False)
class HalfFit:
    """One half of some frames, and the predictions by the matrix of the other half.

    Parameters
    ----------
    slopes
        Slopes of the half's rows ``(n, n_slopes)``.
    predicted, instrument
        Predictions from commands and from pokes for all rows ``(n_rows, n_slopes)``, of any scale.
    now
        Indices of the half's rows among all ``(n,)``.
    """

    slopes: NDArray[np.float32]
    predicted: NDArray[np.float32]
    instrument: NDArray[np.float32]
    now: NDArray[np.intp]
    sums: LagSums


def fit_halves(sampled: FilteredTelemetry, lags: int) -> list[HalfFit]:
    """Regress the slopes of each half of some frames on the predictions by the matrix of the other."""
    now = sampled.now
    slopes = sampled.slopes - sampled.slopes.mean(axis=0)
    commands = sampled.commands - sampled.commands.mean(axis=0)
    pokes = sampled.pokes - sampled.pokes.mean(axis=0) if sampled.closed else commands
    few = np.ascontiguousarray(slopes[:, ::3])
    powers = [np.square(few.T @ shift_rows(pokes, now, lag)).sum() for lag in range(lags)]
    best_lag = int(np.argmax(powers))
    middle = now.size // 2
    parts = [slice(0, middle), slice(middle, now.size)]
    matrices = []
    for part in parts:
        rows = (shift_rows(excitation, now[part], best_lag) for excitation in (commands, pokes))
        matrices.append(InstrumentalEquations.from_rows(slopes[part], *rows).solve(_DAMPING).T)
    # The noise of the two halves is independent.
    power = np.einsum("ms,ms->m", *matrices, dtype=np.float64)
    fits = []
    for matrix, part in zip(matrices, parts[::-1], strict=True):
        predicted, instrument = predict_slopes(sampled, matrix, power)
        sums = LagSums(lags).add(
            slopes[part], stack_lags(predicted, now[part], lags), stack_lags(instrument, now[part], lags)
        )
        # The noise of each half enters both results: in its slopes, and in the other's predictions.
        signal = float(power.sum() / max(np.square(matrix, dtype=np.float64).sum(), 1e-300))
        sums.scale_covariance(2 - float(np.clip(signal, 0, 1)))
        fits.append(HalfFit(slopes[part], predicted, instrument, now[part], sums))
    return fits


def stack_lags(rows: NDArray[np.float32], now: NDArray[np.intp], lags: int) -> NDArray[np.float32]:
    """``rows[now - lag]`` for every lag ``(n, lags, n_columns)``."""
    return np.stack([shift_rows(rows, now, lag) for lag in range(lags)], axis=1)


class ResponseTracker:
    """Estimates the temporal response during a run.

    The matrix of all frames so far predicts the next ones, whose noise is independent of its errors.

    ``first``: response of the first frames, which the sums of the matrix assume; ``spectra``: output of
    :func:`compute_lag_covariances` for the first frames.
    """

    def __init__(self, first: ResponseEstimate, spectra: NDArray[np.float64]) -> None:
        self._first, self._spectra = first, spectra
        #: Sums of the frames after the first ones.
        self._sums = LagSums(first.weights.size)

    def add(self, data: FilteredTelemetry, matrix: NDArray[np.float64], power: NDArray[np.float64]) -> None:
        """Add a block of filtered telemetry, with the rows of the lags before it.

        ``matrix``: matrix of the frames before it for the sampled slopes ``(n_few, n_modes)``.
        """
        step, lags = sampling_step(data.n_slopes), self._first.weights.size
        slopes = data.slopes[:, ::step]
        predicted, instrument = predict_slopes(data, np.ascontiguousarray(matrix.T, np.float32), power)
        z = stack_lags(instrument, data.now, lags)
        x = z if predicted is instrument else stack_lags(predicted, data.now, lags)
        self._sums.add(slopes - slopes.mean(axis=0), x, z)
        self._spectra += compute_lag_covariances(data, lags)

    def arrays(self) -> dict[str, NDArray[np.float64]]:
        """The arrays of its sums by name; views, through which they can be restored."""
        return {"spectra": self._spectra, **self._sums.arrays()}

    def response(self) -> ResponseEstimate:
        """The response by all frames so far."""
        if self._sums.count < _MIN_FRAMES_PER_LAG * self._first.weights.size:
            return self._first
        return self._first.combine_with(self._sums.response())

    def scale(self, response: ResponseEstimate) -> NDArray[np.float64]:
        """Factors on the columns of the matrix that correct the response assumed in its sums.

        All slopes respond with the same weights, so an error of the assumed response scales the columns: by a
        common factor if the pokes of all modes have the same spectrum.
        """
        seen_spectra = self._spectra @ self._first.weights
        return np.asarray((seen_spectra @ self._first.weights) / (seen_spectra @ response.weights))

    def gain_sigma(self, response: ResponseEstimate) -> float:
        """Standard error of the factor on the whole matrix by the errors of the response."""
        seen_spectra = self._spectra.mean(axis=0) @ self._first.weights
        variance = max(float(seen_spectra @ response.covariance @ seen_spectra), 0.0)
        return float(np.sqrt(variance)) / abs(float(response.weights @ seen_spectra))


def require_no_late_response(data: AlignedTelemetry, whitener: NDArray[np.float64], lags: int) -> None:
    """Raise if the sensor responds after the last lag, which would bias the matrix unnoticed.

    Whitened pokes are correlated from frame to frame, so a response after the last lag appears in the matrix
    with the wrong size or sign. Its remainder in the slopes is correlated with the pokes of later lags; noise
    is not.

    Raises
    ------
    CalibrationError
        The sensor responds after the last lag; the message says when.
    """
    parts = fit_halves(
        filter_telemetry(data.select_slopes(RESPONSE_SLOPES), whitener, lags + _EXTRA_LAGS), lags
    )
    late_responses = np.array([_late_response(part, lags) for part in parts])
    fraction, significance = late_responses[:, 0], late_responses[:, 1]
    # The same lag must be significant in both halves.
    is_late = (np.abs(fraction).min(axis=0) > _MIN_FRACTION) & (significance.min(axis=0) > _MIN_SIGNIFICANCE)
    if is_late.any():
        lag = lags + int(np.argmax(np.where(is_late, np.abs(fraction).min(axis=0), 0.0)))
        raise CalibrationError(
            f"the sensor responds to pokes {lag} frames after they were sent, beyond calibration.lags = "
            f"{lags} frames; set calibration.lags to at least {lag + 3}"
        )


def _late_response(part: HalfFit, lags: int) -> NDArray[np.float64]:
    """Share of the response and significance in standard errors for each later lag ``(2, n)``."""
    residuals, weights = part.slopes.astype(float), part.sums.weights()
    for lag, weight in enumerate(weights):
        residuals -= weight * shift_rows(part.predicted, part.now, lag)
    size = float(np.vdot(*(shift_rows(rows, part.now, 0) for rows in (part.instrument, part.predicted))))
    size *= np.abs(weights).max()
    rows = []
    for lag in range(lags, lags + _EXTRA_LAGS):
        # Errors are correlated between slopes, and (whitened) independent between frames.
        scores = np.einsum("ts,ts->t", shift_rows(part.instrument, part.now, lag), residuals)
        rows.append([scores.sum() / size, abs(scores.sum()) / np.sqrt(np.square(scores).sum())])
    return np.array(rows).T


class ResponseAccumulator:
    """Temporal response from pokes in a running loop, for as long as it runs.

    Slopes are regressed on the predictions of a matrix from the commands, with its predictions from the pokes
    as instruments.
    """

    def __init__(self, lags: int) -> None:
        self._sums, self._lags = LagSums(lags), lags
        self._auto = np.zeros((lags, lags))

    def add(self, block: FilteredTelemetry, matrix: NDArray[np.float64]) -> None:
        """Add a block of filtered telemetry with the rows of the lags before it.

        ``matrix``: the best known matrix ``(n_slopes, n_modes)``.
        """
        stride = sampling_step(block.n_slopes)
        sampled_matrix = matrix[::stride].T.astype(np.float32)
        command_slopes = stack_lags(block.commands @ sampled_matrix, block.now, self._lags)
        poke_slopes = stack_lags(block.pokes @ sampled_matrix, block.now, self._lags)
        slopes = block.slopes[:, ::stride]
        slopes = slopes - slopes.mean(axis=0)
        inverse_variance = 1 / np.maximum(slopes.var(axis=0), 1e-12 * float(slopes.var()) + 1e-30)
        instruments = (poke_slopes - poke_slopes.mean(axis=0)) * inverse_variance
        self._sums.add(slopes, command_slopes - command_slopes.mean(axis=0), instruments)
        self._auto += np.einsum("tls,tks->lk", instruments, poke_slopes, optimize=True)

    def response(self, known: TemporalResponse | None) -> TemporalResponse:
        """The measured response, or the known one while its errors are smaller and the two agree."""
        if not self._auto.any():
            if known is None:
                raise RuntimeError("no frames yet, and no response is known")
            return known
        return select_response(self._sums.response().response, known)

    def gain_sigma(self, response: TemporalResponse) -> float:
        """Relative error of the gain of a matrix by the errors of the response."""
        if not self._auto.any():
            return 0.0
        weighted_auto = self._auto @ response.weights
        power = float(response.weights @ weighted_auto)
        # The errors of the weights sum to zero, so only deviations from the mean of the lags count.
        spread = float(np.sqrt(np.square((weighted_auto - power) * response.sigma).sum()))
        return spread / max(abs(power), 1e-300)


def select_response(measured: TemporalResponse, known: TemporalResponse | None) -> TemporalResponse:
    """The known response if its errors are smaller and it agrees with the measured one, else the latter."""
    if (
        known is not None
        and known.sigma.max() < measured.sigma.max()
        and not responses_differ(measured, known)
    ):
        return known
    return measured


def responses_differ(measured: TemporalResponse, known: TemporalResponse) -> bool:
    """Whether two responses differ by more than their errors explain."""
    errors = np.hypot(measured.sigma, known.sigma)
    difference = np.abs(measured.weights - known.weights)
    return bool((difference > np.maximum(_MAX_DIFFERENCE_SIGMA * errors, _NEGLIGIBLE_DIFFERENCE)).any())
