"""Temporal response of mirror and sensor (weight per frame of lag), estimated by instrumental variables from the run itself."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import toeplitz

from escape_hw.api.results import TemporalResponse
from escape_hw.calibration.acquisition.telemetry import AlignedTelemetry
from escape_hw.calibration.docrime.regression import N_SAMPLED_SLOPES, sampling_step
from escape_hw.calibration.docrime.whitening import apply_filter
from escape_hw.errors import CalibrationError

#: Share of the largest singular value below which a direction counts as not seen: single precision ends here.
_RCOND = 1e-7


@dataclass(frozen=True, slots=True, eq=False)
class ResponseEstimate:
    """A temporal response with the covariance of its weights ``(lags, lags)``, whose errors sum to zero."""

    weights: NDArray[np.float64]
    covariance: NDArray[np.float64]

    @property
    def response(self) -> TemporalResponse:
        """With standard errors alone."""
        return TemporalResponse(self.weights, np.sqrt(np.maximum(np.diag(self.covariance), 0.0)))

    def combine_with(self, other: ResponseEstimate) -> ResponseEstimate:
        """The mean of two independent estimates, weighed by their covariances."""
        inverse_sum = np.linalg.pinv(self.covariance + other.covariance, rcond=_RCOND, hermitian=True)
        weight = self.covariance @ inverse_sum
        covariance = self.covariance - weight @ self.covariance
        return ResponseEstimate(
            self.weights + weight @ (other.weights - self.weights), (covariance + covariance.T) / 2
        )


class LagSums:
    """Weights of the lags by instrumental variables, and their errors.

    With slopes ``y``, predictions ``x`` from the commands and ``z`` from the pokes, the instruments,
    the weights solve ``sum_t z_l(t) (y(t) - sum_k w_k x_k(t)) = 0`` (Söderström & Stoica 1983). Each
    frame's products ``z_l y`` and ``z_l x_k`` are summed, and so are the products of those with each
    other: that gives the scores' covariance for whatever weights come out in the end (White 1980), in
    which slopes may err together, but frames do not.

    Parameters
    ----------
    lags
        Number of lags.
    """

    def __init__(self, lags: int) -> None:
        self._lags, size = lags, lags * (lags + 1)
        self._products, self._score_products = np.zeros(size), np.zeros((size, size))
        self._frames = np.zeros(1)

    def add(
        self, slopes: NDArray[np.float32], predicted: NDArray[np.float32], instrument: NDArray[np.float32]
    ) -> Self:
        """Add frames: slopes ``(n, n_slopes)``, predictions and instruments ``(n, lags, n_slopes)``, centred.

        All predictions should have one scale: what they miss of the commands' motion is noise.
        """
        regressors = np.concatenate([slopes[:, None], predicted], axis=1).transpose(0, 2, 1)
        products = np.matmul(instrument, regressors).reshape(len(slopes), -1).astype(np.float64)
        self._products += products.sum(axis=0)
        self._score_products += products.T @ products
        self._frames += len(slopes)
        return self

    def merge(self, other: LagSums) -> Self:
        """Add the frames of another."""
        for name, array in self.arrays().items():
            array += other.arrays()[name]
        return self

    def scale_covariance(self, factor: float) -> Self:
        """Multiply the scores' covariance, for frames that do not err independently."""
        self._score_products *= factor
        return self

    def arrays(self) -> dict[str, NDArray[np.float64]]:
        """All sums by name, themselves and no copies: written into, they are restored."""
        return {"products": self._products, "squares": self._score_products, "frames": self._frames}

    @property
    def count(self) -> int:
        """Frames added."""
        return int(self._frames[0])

    def weights(self) -> NDArray[np.float64]:
        """Weights of the lags as regressed, of any scale ``(lags,)``."""
        right_hand_side, bread = self._solve_normal_equations()
        return np.asarray(bread @ right_hand_side)

    def response(self) -> ResponseEstimate:
        """The weights scaled to sum 1."""
        right_hand_side, bread = self._solve_normal_equations()
        weights = bread @ right_hand_side
        total = weights.sum()
        score = np.kron(np.eye(self._lags), np.concatenate([[1.0], -weights]))
        # Scaled to sum 1, a weight errs with all others: d(w / sum) = (1 - w 1^T) dw / sum.
        scaled = (np.eye(self._lags) - (weights / total)[:, None]) @ bread @ score / total
        return ResponseEstimate(weights / total, scaled @ self._score_products @ scaled.T)

    def _solve_normal_equations(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Right-hand side and inverse of the normal equations."""
        table = self._products.reshape(self._lags, self._lags + 1)
        return table[:, 0], np.asarray(np.linalg.pinv(table[:, 1:], rcond=_RCOND))


#: Slopes that the response is estimated from, evenly spread; more tell little and take time.
RESPONSE_SLOPES = N_SAMPLED_SLOPES
#: Share of a matrix's power that is taken for signal at least.
_MIN_SIGNAL_FRACTION = 0.01
#: Frames per lag without which the later frames' errors are not known.
_MIN_FRAMES_PER_LAG = 40


@dataclass(frozen=True, slots=True, eq=False)
class FilteredTelemetry:
    """Filtered telemetry.

    Parameters
    ----------
    rows
        Filtered slopes and commands ``(n_rows, n_slopes + n_modes)``, in closed loop with the filtered
        pokes beside them.
    now
        Rows whose slopes and whose commands of all lags are known ``(n,)``, rising.
    n_slopes, n_modes
        How many columns are slopes, and how many commands.
    """

    rows: NDArray[np.float32]
    now: NDArray[np.intp]
    n_slopes: int
    n_modes: int

    @property
    def slopes(self) -> NDArray[np.float32]:
        """Slopes of the usable rows ``(n, n_slopes)``."""
        return self.rows_before(0)[:, : self.n_slopes]

    @property
    def commands(self) -> NDArray[np.float32]:
        """Commands of all rows ``(n_rows, n_modes)``."""
        return self.rows[:, self.n_slopes : self.n_slopes + self.n_modes]

    @property
    def pokes(self) -> NDArray[np.float32]:
        """Pokes of all rows ``(n_rows, n_modes)``; in open loop these are the commands."""
        return self.rows[:, self.rows.shape[1] - self.n_modes :]

    @property
    def closed(self) -> bool:
        """Whether commands hold more than pokes."""
        return bool(self.rows.shape[1] > self.n_slopes + self.n_modes)

    def rows_before(self, lag: int) -> NDArray[np.float32]:
        """The rows ``lag`` rows before the usable ones."""
        return shift_rows(self.rows, self.now, lag)

    def excitation(self, response: NDArray[np.float64]) -> NDArray[np.float32]:
        """Commands as the usable rows' slopes saw them ``(n, n_modes)``, pokes beside them in closed loop."""
        return apply_filter(self.rows, response, self.now, self.n_slopes)


def shift_rows(rows: NDArray[np.float32], now: NDArray[np.intp], lag: int) -> NDArray[np.float32]:
    """``rows[now - lag]``; a view where ``now`` is unbroken."""
    if now.size and now[-1] - now[0] + 1 == now.size:
        return rows[now[0] - lag : now[-1] - lag + 1]
    return rows[now - lag]


def find_usable_rows(data: AlignedTelemetry, order: int, lags: int) -> NDArray[np.intp]:
    """Rows whose filtered slopes and filtered pokes of all lags are known."""
    return data.find_complete_rows(order, lags + order)


def filter_telemetry(
    data: AlignedTelemetry, whitener: NDArray[np.float64], lags: int, start: int = 0
) -> FilteredTelemetry:
    """Filter slopes and pokes alike.

    Parameters
    ----------
    data
        Slopes and pokes.
    whitener
        Filter over time.
    lags
        Lags that must be known.
    start
        First row whose slopes are wanted.
    """
    order = whitener.size - 1
    at = find_usable_rows(data, order, lags)
    at = at[np.searchsorted(at, start) :]
    first = max(start - lags, order)
    rows = apply_filter(data.rows, whitener, np.arange(first, data.present.size))
    return FilteredTelemetry(rows, at - first, data.n_slopes, data.n_modes)


def compute_lag_covariances(data: FilteredTelemetry, lags: int) -> NDArray[np.float64]:
    """Sums of the filtered commands ``l`` rows ago times the pokes ``k`` rows ago.

    Returns
    -------
    ndarray, ``(1, lags, lags)`` or ``(n_modes, lags, lags)``
        Element ``[., l, k]``. In open loop every mode's pokes have the same spectrum, and one serves
        all; in closed loop the controller gives each mode its own.
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
    """Share of the final response in each of the frames after a command.

    Every slope answers to the same few lags, so the lags are regressed on what a provisional matrix
    predicts. That matrix is noisy. Fitted to the same frames, its noise would pass for response at
    the neighbouring lags; the frames are therefore cut in half, and the matrix of one half predicts
    the other (its noise then only scales all lags alike, and the weights are scaled to sum 1). In
    closed loop the pokes are the instruments of the commands, for the matrix and for the lags alike.

    Parameters
    ----------
    data
        Frames and pokes; enough rows for a matrix in each half (see :func:`find_usable_rows`).
    whitener
        Filter over time for slopes and pokes alike.
    lags
        Number of lags.

    Returns
    -------
    ResponseEstimate
        Its errors hold for turbulence that moves neighbouring slopes together.
    """
    sums = LagSums(lags)
    for part in fit_halves(filter_telemetry(data.select_slopes(RESPONSE_SLOPES), whitener, lags), lags):
        sums.merge(part.sums)
    return sums.response()


def predict_slopes(
    data: FilteredTelemetry, matrix: NDArray[np.float32], power: NDArray[np.float64]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """What a noisy matrix makes of commands and pokes, of all rows ``(n_rows, n_slopes)``, centred.

    Noise makes a matrix longer and tells nothing. With ``c`` the power of its answer to the pokes without
    its noise and ``v`` that with it, what it makes of the pokes weighs best by ``sqrt(c) / v``, whatever the
    matrix's own scale. Where each mode's commands have a spectrum of their own, in closed loop, the noisy
    modes' would count too much in what is predicted, and the lags be mistaken: there each mode is
    shortened to what its noise leaves of it.

    Parameters
    ----------
    data
        Filtered telemetry.
    matrix
        Any matrix that owes nothing to the noise of these frames ``(n_modes, n_slopes)``.
    power
        Sum of squares of each mode's column without its noise ``(n_modes,)``.

    Returns
    -------
    made, poked : ndarray
        One and the same in open loop.
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
    """One half of a stretch of frames, and what the matrix of the other half makes of it.

    Parameters
    ----------
    slopes
        Slopes of the half's rows ``(n, n_slopes)``.
    predicted, instrument
        What the other half's matrix makes of the commands and of the pokes alone, of all rows
        ``(n_rows, n_slopes)``, of any scale.
    now
        Where the half's rows stand among all ``(n,)``.
    sums
        Regression of the slopes on what is predicted.
    """

    slopes: NDArray[np.float32]
    predicted: NDArray[np.float32]
    instrument: NDArray[np.float32]
    now: NDArray[np.intp]
    sums: LagSums


def fit_halves(sampled: FilteredTelemetry, lags: int) -> list[HalfFit]:
    """Both halves of some filtered frames, each seen with the matrix of the other."""
    slopes, commands = (
        sampled.slopes - sampled.slopes.mean(axis=0),
        sampled.commands - sampled.commands.mean(axis=0),
    )
    pokes, now = sampled.pokes - sampled.pokes.mean(axis=0) if sampled.closed else commands, sampled.now
    best_lag = _find_strongest_lag(slopes, pokes, now, lags)
    middle = now.size // 2
    parts = [slice(0, middle), slice(middle, now.size)]
    matrices = [
        _instrumental_matrix(
            slopes[part], shift_rows(commands, now[part], best_lag), shift_rows(pokes, now[part], best_lag)
        )
        for part in parts
    ]
    # The noise of one half knows nothing of the other's.
    power = np.einsum("ms,ms->m", *matrices, dtype=np.float64)
    fits = []
    for matrix, part in zip(matrices, parts[::-1], strict=True):
        predicted, instrument = predict_slopes(sampled, matrix, power)
        sums = LagSums(lags).add(
            slopes[part], stack_lags(predicted, now[part], lags), stack_lags(instrument, now[part], lags)
        )
        # The noise of either half's matrix is also in the other half's slopes: errors of both are shared.
        signal = float(power.sum() / max(np.square(matrix, dtype=np.float64).sum(), 1e-300))
        sums.scale_covariance(2 - float(np.clip(signal, 0, 1)))
        fits.append(HalfFit(slopes[part], predicted, instrument, now[part], sums))
    return fits


def stack_lags(rows: NDArray[np.float32], now: NDArray[np.intp], lags: int) -> NDArray[np.float32]:
    """``rows[now - lag]`` for every lag ``(n, lags, n_columns)``."""
    return np.stack([shift_rows(rows, now, lag) for lag in range(lags)], axis=1)


def _find_strongest_lag(
    slopes: NDArray[np.float32], pokes: NDArray[np.float32], now: NDArray[np.intp], lags: int
) -> int:
    sampled = np.ascontiguousarray(slopes[:, ::3])
    return int(np.argmax([np.square(sampled.T @ shift_rows(pokes, now, lag)).sum() for lag in range(lags)]))


def _instrumental_matrix(
    slopes: NDArray[np.float32], commands: NDArray[np.float32], pokes: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Matrix ``(n_modes, n_slopes)``, pokes being the instruments of the commands."""
    link = pokes.T @ commands
    # Half a short run may hold fewer frames than modes; a little damping keeps the matrix finite.
    link[np.diag_indices_from(link)] += 1e-2 * np.trace(link) / len(link)
    return np.asarray(np.linalg.solve(link, pokes.T @ slopes))


class ResponseTracker:
    """Keeps estimating the temporal response while a run goes on.

    The matrix of all frames so far predicts the next ones, whose noise knows nothing of it.

    Parameters
    ----------
    first
        Response of the first frames, through which the commands of the matrix are seen.
    spectra
        From :func:`compute_lag_covariances`, of the first frames.
    """

    def __init__(self, first: ResponseEstimate, spectra: NDArray[np.float64]) -> None:
        self._first, self._spectra = first, spectra
        #: Of the frames after the first, whose matrices have one scale.
        self._sums = LagSums(first.weights.size)

    def add(self, data: FilteredTelemetry, matrix: NDArray[np.float64], power: NDArray[np.float64]) -> None:
        """Take a block of filtered slopes and commands, with the rows of the lags before it.

        Parameters
        ----------
        data
            The block.
        matrix
            Of the frames before it ``(n_few, n_modes)``, of the slopes that ``RegressionSums.some`` has.
        power
            As for :func:`predict_slopes`.
        """
        step, lags = sampling_step(data.n_slopes), self._first.weights.size
        slopes = data.slopes[:, ::step]
        predicted, instrument = predict_slopes(data, np.ascontiguousarray(matrix.T, np.float32), power)
        z = stack_lags(instrument, data.now, lags)
        x = z if predicted is instrument else stack_lags(predicted, data.now, lags)
        self._sums.add(slopes - slopes.mean(axis=0), x, z)
        self._spectra += compute_lag_covariances(data, lags)

    def arrays(self) -> dict[str, NDArray[np.float64]]:
        """What it has gathered by name, themselves and no copies: written into, they are restored."""
        return {"spectra": self._spectra, **self._sums.arrays()}

    def response(self) -> ResponseEstimate:
        """The response of all rows so far."""
        if self._sums.count < _MIN_FRAMES_PER_LAG * self._first.weights.size:
            return self._first
        return self._first.combine_with(self._sums.response())

    def scale(self, response: ResponseEstimate) -> NDArray[np.float64]:
        """Factors on the columns of a matrix whose commands were seen through the assumed response.

        Every slope answers through the same response, so seeing a mode's commands through a slightly
        wrong one only scales its column: by one factor where all modes' pokes have one spectrum.
        """
        seen_spectra = self._spectra @ self._first.weights
        return np.asarray((seen_spectra @ self._first.weights) / (seen_spectra @ response.weights))

    def gain_sigma(self, response: ResponseEstimate) -> float:
        """Standard error of the factor that the response's errors put on all of a matrix."""
        seen_spectra = self._spectra.mean(axis=0) @ self._first.weights
        variance = max(float(seen_spectra @ response.covariance @ seen_spectra), 0.0)
        return float(np.sqrt(variance)) / abs(float(response.weights @ seen_spectra))


#: Frames beyond the lags in which an answer is looked for.
_EXTRA_LAGS = 8
#: Standard errors by which it must stand out, and its least share of the response that was found.
_MIN_SIGNIFICANCE, _MIN_FRACTION = 6.0, 0.25


def require_no_late_response(data: AlignedTelemetry, whitener: NDArray[np.float64], lags: int) -> None:
    """Refuse to go on with too few lags, which would give a matrix that is wrong and looks sound.

    Whitened pokes are correlated from frame to frame, so a response later than all lags still shows in
    them, with the wrong size or even sign. What such a response leaves in the slopes goes with the pokes
    of the later lags, and noise does not.

    Parameters
    ----------
    data
        Frames and pokes.
    whitener
        Filter over time.
    lags
        Number of lags of the temporal response.

    Raises
    ------
    CalibrationError
        There is an answer after the last lag; says when.
    """
    parts = fit_halves(
        filter_telemetry(data.select_slopes(RESPONSE_SLOPES), whitener, lags + _EXTRA_LAGS), lags
    )
    late_responses = np.array([_late_response(part, lags) for part in parts])
    fraction, significance = late_responses[:, 0], late_responses[:, 1]
    # The same lag in both halves, each with the matrix of the other.
    is_late = (np.abs(fraction).min(axis=0) > _MIN_FRACTION) & (significance.min(axis=0) > _MIN_SIGNIFICANCE)
    if is_late.any():
        lag = lags + int(np.argmax(np.where(is_late, np.abs(fraction).min(axis=0), 0.0)))
        raise CalibrationError(
            f"the sensor answers pokes {lag} frames after they were sent, later than calibration.lags = "
            f"{lags} frames can tell; set calibration.lags to at least {lag + 3}"
        )


def _late_response(part: HalfFit, lags: int) -> NDArray[np.float64]:
    """For each later lag, its share of the response found, and by how many standard errors ``(2, n)``."""
    residuals, weights = part.slopes.astype(float), part.sums.weights()
    for lag, weight in enumerate(weights):
        residuals -= weight * shift_rows(part.predicted, part.now, lag)
    size = float(np.vdot(*(shift_rows(rows, part.now, 0) for rows in (part.instrument, part.predicted))))
    size *= np.abs(weights).max()
    rows = []
    for lag in range(lags, lags + _EXTRA_LAGS):
        # Neighbouring slopes err together, frames (whitened) do not.
        scores = np.einsum("ts,ts->t", shift_rows(part.instrument, part.now, lag), residuals)
        rows.append([scores.sum() / size, abs(scores.sum()) / np.sqrt(np.square(scores).sum())])
    return np.array(rows).T
