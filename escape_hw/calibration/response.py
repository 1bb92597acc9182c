"""The temporal response of mirror and sensor, estimated from the run itself."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_toeplitz, toeplitz

from escape_hw.api.results import TemporalResponse
from escape_hw.calibration.telemetry import Telemetry
from escape_hw.calibration.whitening import apply_filter

#: Slopes that the response is estimated from, evenly spread; more tell little and take time.
SLOPES = 128


def usable_rows(data: Telemetry, order: int, lags: int) -> NDArray[np.intp]:
    """Rows whose filtered slopes and filtered pokes of all lags are known."""
    return data.complete(order, lags + order)


def filtered(
    data: Telemetry, whitener: NDArray[np.float64], lags: int, start: int = 0
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.intp]]:
    """Filtered slopes of all usable rows, filtered pokes of all rows, and where the two meet.

    Parameters
    ----------
    data
        Slopes and pokes.
    whitener
        Filter over time.
    lags
        Lags that must be known.
    start
        First row wanted.

    Returns
    -------
    slopes : ndarray, ``(n, n_slopes)``
    pokes : ndarray, ``(n_rows, n_modes)``
    now : ndarray, ``(n,)``
        Row of ``pokes`` of the same moment as each row of ``slopes``; the lags before it are there.
    """
    order = whitener.size - 1
    at = usable_rows(data, order, lags)
    at = at[at >= start]
    slopes = apply_filter(data.slopes, whitener, at)
    # Pokes are known on every row, so one filtered copy serves all lags.
    first = max(start - lags, order) if at.size else order
    return slopes, apply_filter(data.pokes, whitener, np.arange(first, data.present.size)), at - first


def autocovariance(pokes: NDArray[np.float32], now: NDArray[np.intp], lags: int) -> NDArray[np.float64]:
    """Autocovariance of the filtered pokes by lag ``(lags,)``."""
    present = pokes[now]
    return np.array([float(np.vdot(present, pokes[now - lag])) for lag in range(lags)])


def fit_response(data: Telemetry, whitener: NDArray[np.float64], lags: int) -> TemporalResponse:
    """Share of the final response in each of the frames after a command.

    Every slope answers to the same few lags, so the lags are regressed on what a provisional matrix
    predicts. That matrix is noisy. Fitted to the same frames, its noise would pass for response at
    the neighbouring lags; the frames are therefore cut in half, and the matrix of one half predicts
    the other (its noise then only scales all lags alike, and the weights are scaled to sum 1).

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
    TemporalResponse
        Standard errors hold for turbulence that moves neighbouring slopes together.
    """
    slopes, pokes, now = filtered(data.thinned(SLOPES), whitener, lags)
    slopes -= slopes.mean(axis=0)
    pokes -= pokes.mean(axis=0)
    best = _strongest_lag(slopes, pokes, now, lags)
    middle = now.size // 2
    parts = [slice(0, middle), slice(middle, now.size)]
    weights, covariances = [], []
    for here, there in (parts, parts[::-1]):
        w, c = _regress(slopes, pokes @ _matrix(slopes[here], pokes[now[here] - best]), now, lags, there)
        weights.append(w)
        covariances.append(c)
    mean = np.mean(weights, axis=0)
    return TemporalResponse(mean, np.sqrt(np.diag(np.sum(covariances, axis=0))) / 2)


def _strongest_lag(
    slopes: NDArray[np.float32], pokes: NDArray[np.float32], now: NDArray[np.intp], lags: int
) -> int:
    few = np.ascontiguousarray(slopes[:, ::2])
    return int(np.argmax([np.square(few.T @ pokes[now - lag]).sum() for lag in range(lags)]))


def _matrix(slopes: NDArray[np.float32], pokes: NDArray[np.float32]) -> NDArray[np.float32]:
    """Least squares ``(n_modes, n_slopes)``."""
    gram = (pokes.T @ pokes).astype(np.float64)
    # Half a short run may hold fewer frames than modes; a little damping keeps the matrix finite.
    gram[np.diag_indices_from(gram)] += 1e-2 * np.trace(gram) / len(gram)
    return np.linalg.solve(gram, pokes.T @ slopes).astype(np.float32)


def _regress(
    slopes: NDArray[np.float32],
    predicted: NDArray[np.float32],
    now: NDArray[np.intp],
    lags: int,
    part: slice,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Weights of the lags, scaled to sum 1, and their covariance, on a part of the rows."""
    at, y = now[part], slopes[part]
    z = np.stack([predicted[at - lag] for lag in range(lags)])
    flat = z.reshape(lags, -1)
    normal = (flat @ flat.T).astype(np.float64)
    weights = np.linalg.solve(normal, (flat @ y.ravel()).astype(np.float64))
    error = y - np.tensordot(weights.astype(np.float32), z, axes=1)
    # One score per frame: neighbouring slopes err together, frames (whitened) do not.
    scores = np.einsum("lts,ts->lt", z, error).astype(np.float64)
    bread = np.linalg.inv(normal)
    total = weights.sum()
    weights = weights / total
    # Scaled to sum 1, a weight errs with all others: d(w / sum) = (1 - w 1^T) dw / sum.
    scaled = (np.eye(lags) - weights[:, None]) @ bread / total
    return weights, scaled @ (scores @ scores.T) @ scaled.T


class ResponseTracker:
    """Keeps estimating the temporal response while a run goes on.

    The matrix of the first frames predicts all later ones, whose noise knows nothing of it.

    Parameters
    ----------
    matrix
        Matrix of the first frames ``(n_slopes, n_modes)``.
    first
        Response of the first frames.
    rows
        Number of rows it came from.
    autocovariance
        Of the filtered pokes, by lag ``(lags,)``, any unit.
    """

    def __init__(
        self,
        matrix: NDArray[np.float64],
        first: TemporalResponse,
        rows: int,
        autocovariance: NDArray[np.float64],
    ) -> None:
        self._step = max(1, -(-matrix.shape[0] // SLOPES))
        self._matrix = np.ascontiguousarray(matrix[:: self._step].T, np.float32)
        self._first, self._first_rows = first, rows
        self._autocovariance = autocovariance
        lags = first.weights.size
        self._normal, self._right, self.rows = np.zeros(lags), np.zeros(lags), 0

    def add(self, slopes: NDArray[np.float32], pokes: NDArray[np.float32], now: NDArray[np.intp]) -> None:
        """Take filtered slopes and pokes of a block.

        Parameters
        ----------
        slopes
            ``(n, n_slopes)``.
        pokes
            ``(n_rows, n_modes)``, every row of the block and of the lags before it.
        now
            Row of ``pokes`` that each row of ``slopes`` belongs to ``(n,)``, rising.
        """
        z = pokes @ self._matrix
        y = np.ascontiguousarray(slopes[:, :: self._step])
        unbroken = now[-1] - now[0] + 1 == now.size
        for lag in range(self._right.size):
            past = z[now[0] - lag : now[-1] - lag + 1] if unbroken else z[now - lag]
            present = z[now[0] : now[-1] + 1] if unbroken else z[now]
            self._right[lag] += np.vdot(y, past)
            self._normal[lag] += np.vdot(present, past)
        self.rows += now.size

    def response(self) -> TemporalResponse:
        """The response of all rows so far."""
        if self.rows < self._first_rows:
            return self._first
        weights = solve_toeplitz(self._normal, self._right)
        share = self._first_rows / (self._first_rows + self.rows)
        mean = share * self._first.weights + (1 - share) * weights / weights.sum()
        return TemporalResponse(mean, self._first.sigma * np.sqrt(share))

    def scale(self) -> float:
        """Factor on a matrix whose pokes were seen through the first response.

        Every slope answers through the same response and every mode's pokes have the same spectrum,
        so seeing them through a slightly wrong one only scales the matrix.
        """
        assumed = self._first.weights
        seen = toeplitz(self._autocovariance) @ assumed
        return float((assumed @ seen) / (self.response().weights @ seen))
