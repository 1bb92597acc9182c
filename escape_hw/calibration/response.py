"""The temporal response of mirror and sensor, estimated from the run itself."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_toeplitz, toeplitz

from escape_hw.api.results import TemporalResponse
from escape_hw.calibration.telemetry import Telemetry
from escape_hw.calibration.whitening import apply_filter

#: Slopes that the response is estimated from, evenly spread; more tell little and take time.
SLOPES = 64


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
    """Covariance of the filtered commands ``l`` rows ago with the pokes ``k`` rows ago, any unit.

    Returns
    -------
    ndarray, ``(1, lags, lags)`` or ``(n_modes, lags, lags)``
        Element ``[., l, k]``. In open loop every mode's pokes have the same spectrum, and one serves
        all; in closed loop the controller gives each mode its own.
    """
    n = data.now.size
    commands = np.stack([shifted(data.commands, data.now, lag) for lag in range(lags)])
    if not data.closed:
        flat = commands.reshape(lags, -1)
        first = (flat[0] @ flat.T).astype(np.float64)
        return np.asarray(toeplitz(first)[None] / n)
    pokes = np.stack([shifted(data.pokes, data.now, lag) for lag in range(lags)])
    together = np.einsum("ltm,ktm->mlk", commands, pokes, optimize=True)
    return np.asarray(together.astype(np.float64) / n)


def fit_response(
    data: Telemetry, whitener: NDArray[np.float64], lags: int
) -> tuple[TemporalResponse, NDArray[np.float64]]:
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
    response : TemporalResponse
        Standard errors hold for turbulence that moves neighbouring slopes together.
    covariance : ndarray, ``(lags, lags)``
        Of its weights; their errors sum to zero.
    """
    weights, covariances = [], []
    for part in halves(filtered(data.thinned(SLOPES), whitener, lags), lags):
        total = part.weights.sum()
        weights.append(part.weights / total)
        # Scaled to sum 1, a weight errs with all others: d(w / sum) = (1 - w 1^T) dw / sum.
        scaled = (np.eye(lags) - weights[-1][:, None]) / total
        covariances.append(scaled @ part.covariance @ scaled.T)
    mean = np.mean(weights, axis=0)
    covariance = np.sum(covariances, axis=0) / 4
    return TemporalResponse(mean, np.sqrt(np.diag(covariance))), covariance


@dataclass(frozen=True, slots=True, eq=False)
class Half:
    """One half of a stretch of frames, and what the matrix of the other half makes of it.

    Parameters
    ----------
    slopes
        Slopes of the half's rows ``(n, n_slopes)``.
    predicted, instrument
        What the other half's matrix makes of the commands and of the pokes alone, of all rows
        ``(n_rows, n_slopes)``.
    now
        Where the half's rows stand among all ``(n,)``.
    weights, covariance
        Weights of the lags as regressed, not scaled ``(lags,)``, and their covariance.
    """

    slopes: NDArray[np.float32]
    predicted: NDArray[np.float32]
    instrument: NDArray[np.float32]
    now: NDArray[np.intp]
    weights: NDArray[np.float64]
    covariance: NDArray[np.float64]


def halves(few: Filtered, lags: int) -> list[Half]:
    """Both halves of some filtered frames, each seen with the matrix of the other."""
    slopes, commands = few.slopes - few.slopes.mean(axis=0), few.commands - few.commands.mean(axis=0)
    pokes, now = few.pokes - few.pokes.mean(axis=0) if few.closed else commands, few.now
    best = _strongest_lag(slopes, pokes, now, lags)
    middle = now.size // 2
    parts = [slice(0, middle), slice(middle, now.size)]
    found = []
    for here, there in (parts, parts[::-1]):
        matrix = _matrix(slopes[here], shifted(commands, now[here], best), shifted(pokes, now[here], best))
        predicted = commands @ matrix
        instrument = pokes @ matrix if few.closed else predicted
        found.append(_regress(slopes[there], predicted, instrument, now[there], lags))
    return found


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


def _regress(
    y: NDArray[np.float32],
    predicted: NDArray[np.float32],
    instrument: NDArray[np.float32],
    at: NDArray[np.intp],
    lags: int,
) -> Half:
    """Regress slopes on what the matrix makes of the commands, the pokes being the instruments."""
    x = np.stack([shifted(predicted, at, lag) for lag in range(lags)])
    z = x if instrument is predicted else np.stack([shifted(instrument, at, lag) for lag in range(lags)])
    flat = z.reshape(lags, -1)
    normal = (flat @ x.reshape(lags, -1).T).astype(np.float64)
    right = (flat @ y.ravel()).astype(np.float64)
    weights = np.asarray(np.linalg.solve(normal, right), np.float64)
    error = y - np.tensordot(weights.astype(np.float32), x, axes=1)
    # One score per frame: neighbouring slopes err together, frames (whitened) do not.
    scores = np.einsum("lts,ts->lt", z, error).astype(np.float64)
    bread = np.linalg.inv(normal)
    covariance = np.asarray(bread @ (scores @ scores.T) @ bread.T, np.float64)
    return Half(y, predicted, instrument, at, weights, covariance)


class ResponseTracker:
    """Keeps estimating the temporal response while a run goes on.

    The matrix of the first frames predicts all later ones, whose noise knows nothing of it.

    Parameters
    ----------
    matrix
        Matrix of the first frames ``(n_slopes, n_modes)``.
    first, covariance
        Response of the first frames and the covariance of its weights.
    rows
        Number of rows it came from.
    spectra
        From :func:`covariances`.
    """

    def __init__(
        self,
        matrix: NDArray[np.float64],
        first: TemporalResponse,
        covariance: NDArray[np.float64],
        rows: int,
        spectra: NDArray[np.float64],
    ) -> None:
        self._step = max(1, -(-matrix.shape[0] // SLOPES))
        self._matrix = np.array(matrix[:: self._step].T, np.float32, order="C")
        self._first, self._covariance, self.first_rows = first, covariance, rows
        self._spectra = spectra
        lags = first.weights.size
        #: Products of what the pokes say with the slopes, and with what the commands say, by lag; and
        #: those of commands past with pokes present, which in open loop are the same.
        self._right, self._normal, self._past, self.rows = np.zeros(lags), np.zeros(lags), np.zeros(lags), 0

    def add(self, data: Filtered) -> None:
        """Take a block of filtered slopes and commands, with the rows of the lags before it."""
        z = data.pokes @ self._matrix
        x = data.commands @ self._matrix if data.closed else z
        slopes = np.ascontiguousarray(data.slopes[:, :: self._step])
        present, poked = shifted(x, data.now, 0), shifted(z, data.now, 0)
        for lag in range(self._right.size):
            past = shifted(z, data.now, lag)
            self._right[lag] += np.vdot(slopes, past)
            self._normal[lag] += np.vdot(present, past)
            self._past[lag] += np.vdot(shifted(x, data.now, lag), poked) if data.closed else 0.0
        if not data.closed:
            self._past[:] = self._normal
        self.rows += data.now.size

    def arrays(self) -> dict[str, NDArray[np.floating]]:
        """What it has gathered by name, themselves and no copies: written into, they are restored."""
        return {
            "matrix": self._matrix,
            "spectra": self._spectra,
            "right": self._right,
            "normal": self._normal,
            "past": self._past,
        }

    def response(self) -> TemporalResponse:
        """The response of all rows so far."""
        if self.rows < self.first_rows:
            return self._first
        weights = solve_toeplitz((self._normal, self._past), self._right)
        share = self._share()
        mean = share * self._first.weights + (1 - share) * weights / weights.sum()
        return TemporalResponse(mean, self._first.sigma * np.sqrt(share))

    def scale(self) -> NDArray[np.float64]:
        """Factors on the columns of a matrix whose commands were seen through the first response.

        Every slope answers through the same response, so seeing a mode's commands through a slightly
        wrong one only scales its column: by one factor where all modes' pokes have one spectrum.
        """
        assumed = self._first.weights
        seen = self._spectra @ assumed
        return np.asarray((seen @ assumed) / (seen @ self.response().weights))

    def gain_sigma(self) -> float:
        """Standard error of the factor that the response's errors put on all of a matrix."""
        seen = self._spectra.mean(axis=0) @ self._first.weights
        variance = float(seen @ self._covariance @ seen) * self._share()
        return float(np.sqrt(variance)) / abs(float(self.response().weights @ seen))

    def _share(self) -> float:
        """Share of the rows behind the first response; one as long as nothing else is used."""
        later = self.rows if self.rows >= self.first_rows else 0
        return self.first_rows / (self.first_rows + later)
