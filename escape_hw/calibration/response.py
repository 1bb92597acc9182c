"""The temporal response of mirror and sensor, estimated from the run itself."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import toeplitz

from escape_hw.calibration.lag_sums import LagSums, ResponseEstimate
from escape_hw.calibration.regression import FEW, few_step
from escape_hw.calibration.telemetry import Telemetry
from escape_hw.calibration.whitening import apply_filter

#: Slopes that the response is estimated from, evenly spread; more tell little and take time.
SLOPES = FEW
#: Share of a matrix's power that is taken for signal at least.
_LEAST_SIGNAL = 0.01
#: Frames per lag without which the later frames' errors are not known.
_ENOUGH = 40


@dataclass(frozen=True, slots=True, eq=False)
class Filtered:
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
        return self.before(0)[:, : self.n_slopes]

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

    def before(self, lag: int) -> NDArray[np.float32]:
        """The rows ``lag`` rows before the usable ones."""
        return shifted(self.rows, self.now, lag)

    def driven(self, response: NDArray[np.float64]) -> NDArray[np.float32]:
        """Commands as the usable rows' slopes saw them ``(n, n_modes)``, pokes beside them in closed loop."""
        return apply_filter(self.rows, response, self.now, self.n_slopes)


def shifted(rows: NDArray[np.float32], now: NDArray[np.intp], lag: int) -> NDArray[np.float32]:
    """``rows[now - lag]``; a view where ``now`` is unbroken."""
    if now.size and now[-1] - now[0] + 1 == now.size:
        return rows[now[0] - lag : now[-1] - lag + 1]
    return rows[now - lag]


def usable_rows(data: Telemetry, order: int, lags: int) -> NDArray[np.intp]:
    """Rows whose filtered slopes and filtered pokes of all lags are known."""
    return data.complete(order, lags + order)


def filtered(data: Telemetry, whitener: NDArray[np.float64], lags: int, start: int = 0) -> Filtered:
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
    at = usable_rows(data, order, lags)
    at = at[np.searchsorted(at, start) :]
    first = max(start - lags, order)
    rows = apply_filter(data.rows, whitener, np.arange(first, data.present.size))
    return Filtered(rows, at - first, data.n_slopes, data.n_modes)


def covariances(data: Filtered, lags: int) -> NDArray[np.float64]:
    """Sums of the filtered commands ``l`` rows ago times the pokes ``k`` rows ago.

    Returns
    -------
    ndarray, ``(1, lags, lags)`` or ``(n_modes, lags, lags)``
        Element ``[., l, k]``. In open loop every mode's pokes have the same spectrum, and one serves
        all; in closed loop the controller gives each mode its own.
    """
    commands = np.stack([shifted(data.commands, data.now, lag) for lag in range(lags)])
    if not data.closed:
        flat = commands.reshape(lags, -1)
        first = (flat[0] @ flat.T).astype(np.float64)
        return np.asarray(toeplitz(first)[None])
    pokes = np.stack([shifted(data.pokes, data.now, lag) for lag in range(lags)])
    together = np.einsum("ltm,ktm->mlk", commands, pokes, optimize=True)
    return np.asarray(together.astype(np.float64))


def fit_response(data: Telemetry, whitener: NDArray[np.float64], lags: int) -> ResponseEstimate:
    """Share of the final response in each of the frames after a command.

    Every slope answers to the same few lags, so the lags are regressed on what a provisional matrix
    predicts. That matrix is noisy. Fitted to the same frames, its noise would pass for response at
    the neighbouring lags; the frames are therefore cut in half, and the matrix of one half predicts
    the other (its noise then only scales all lags alike, and the weights are scaled to sum 1). In
    closed loop the pokes are the instruments of the commands, for the matrix and for the lags alike.

    Parameters
    ----------
    data
        Frames and pokes; enough rows for a matrix in each half (see :func:`usable_rows`).
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
    for part in halves(filtered(data.thinned(SLOPES), whitener, lags), lags):
        sums.merge(part.sums)
    return sums.response()


def predictions(
    data: Filtered, matrix: NDArray[np.float32], power: NDArray[np.float64]
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
    noisy = np.square(matrix, dtype=np.float64).sum(axis=1)
    pushed = np.mean(np.square(data.pokes), axis=0, dtype=np.float64)
    whole = max(float(pushed @ noisy), float(np.finfo(np.float32).tiny))
    size = np.sqrt(max(float(pushed @ power) / whole, _LEAST_SIGNAL) / whole)
    poked = data.pokes @ (matrix * np.float32(size))
    poked -= poked.mean(axis=0)
    if not data.closed:
        return poked, poked
    left = power / np.maximum(noisy, np.finfo(np.float32).tiny) / (size * whole)
    made = data.commands @ (matrix * left[:, None]).astype(np.float32)
    made -= made.mean(axis=0)
    return made, poked


@dataclass(frozen=True, slots=True, eq=False)
class Half:
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


def halves(few: Filtered, lags: int) -> list[Half]:
    """Both halves of some filtered frames, each seen with the matrix of the other."""
    slopes, commands = few.slopes - few.slopes.mean(axis=0), few.commands - few.commands.mean(axis=0)
    pokes, now = few.pokes - few.pokes.mean(axis=0) if few.closed else commands, few.now
    best = _strongest_lag(slopes, pokes, now, lags)
    middle = now.size // 2
    parts = [slice(0, middle), slice(middle, now.size)]
    matrices = [
        _matrix(slopes[part], shifted(commands, now[part], best), shifted(pokes, now[part], best))
        for part in parts
    ]
    # The noise of one half knows nothing of the other's.
    power = np.einsum("ms,ms->m", *matrices, dtype=np.float64)
    found = []
    for matrix, part in zip(matrices, parts[::-1], strict=True):
        made, poked = predictions(few, matrix, power)
        sums = LagSums(lags).add(slopes[part], lagged(made, now[part], lags), lagged(poked, now[part], lags))
        # The noise of either half's matrix is also in the other half's slopes: errors of both are shared.
        signal = float(power.sum() / max(np.square(matrix, dtype=np.float64).sum(), 1e-300))
        sums.widen(2 - float(np.clip(signal, 0, 1)))
        found.append(Half(slopes[part], made, poked, now[part], sums))
    return found


def lagged(rows: NDArray[np.float32], now: NDArray[np.intp], lags: int) -> NDArray[np.float32]:
    """``rows[now - lag]`` for every lag ``(n, lags, n_columns)``."""
    return np.stack([shifted(rows, now, lag) for lag in range(lags)], axis=1)


def _strongest_lag(
    slopes: NDArray[np.float32], pokes: NDArray[np.float32], now: NDArray[np.intp], lags: int
) -> int:
    few = np.ascontiguousarray(slopes[:, ::3])
    return int(np.argmax([np.square(few.T @ shifted(pokes, now, lag)).sum() for lag in range(lags)]))


def _matrix(
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
        From :func:`covariances`, of the first frames.
    """

    def __init__(self, first: ResponseEstimate, spectra: NDArray[np.float64]) -> None:
        self._first, self._spectra = first, spectra
        #: Of the frames after the first, whose matrices have one scale.
        self._sums = LagSums(first.weights.size)

    def add(self, data: Filtered, matrix: NDArray[np.float64], power: NDArray[np.float64]) -> None:
        """Take a block of filtered slopes and commands, with the rows of the lags before it.

        Parameters
        ----------
        data
            The block.
        matrix
            Of the frames before it ``(n_few, n_modes)``, of the slopes that ``RegressionSums.some`` has.
        power
            As for :func:`predictions`.
        """
        step, lags = few_step(data.n_slopes), self._first.weights.size
        slopes = data.slopes[:, ::step]
        made, poked = predictions(data, np.ascontiguousarray(matrix.T, np.float32), power)
        z = lagged(poked, data.now, lags)
        x = z if made is poked else lagged(made, data.now, lags)
        self._sums.add(slopes - slopes.mean(axis=0), x, z)
        self._spectra += covariances(data, lags)

    def arrays(self) -> dict[str, NDArray[np.float64]]:
        """What it has gathered by name, themselves and no copies: written into, they are restored."""
        return {"spectra": self._spectra, **self._sums.arrays()}

    def response(self) -> ResponseEstimate:
        """The response of all rows so far."""
        if self._sums.count < _ENOUGH * self._first.weights.size:
            return self._first
        return self._first.combined(self._sums.response())

    def scale(self, response: ResponseEstimate) -> NDArray[np.float64]:
        """Factors on the columns of a matrix whose commands were seen through the assumed response.

        Every slope answers through the same response, so seeing a mode's commands through a slightly
        wrong one only scales its column: by one factor where all modes' pokes have one spectrum.
        """
        seen = self._spectra @ self._first.weights
        return np.asarray((seen @ self._first.weights) / (seen @ response.weights))

    def gain_sigma(self, response: ResponseEstimate) -> float:
        """Standard error of the factor that the response's errors put on all of a matrix."""
        seen = self._spectra.mean(axis=0) @ self._first.weights
        variance = max(float(seen @ response.covariance @ seen), 0.0)
        return float(np.sqrt(variance)) / abs(float(response.weights @ seen))
