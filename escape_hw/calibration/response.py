"""The temporal response of mirror and sensor, estimated from the run itself."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.results import TemporalResponse
from escape_hw.calibration.telemetry import Telemetry
from escape_hw.calibration.whitening import apply_filter

#: Slopes that suffice to tell which lag responds most.
_SAMPLE = 64


def usable_rows(data: Telemetry, order: int, lags: int) -> NDArray[np.intp]:
    """Rows whose filtered slopes and filtered pokes of all lags are known."""
    return data.complete(order, lags + order)


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
    order = whitener.size - 1
    at = usable_rows(data, order, lags)
    slopes = apply_filter(data.slopes, whitener, at)
    slopes -= slopes.mean(axis=0)
    # Pokes are known on every row, so one filtered copy serves all lags.
    pokes = apply_filter(data.pokes, whitener, np.arange(order, data.present.size))
    pokes -= pokes.mean(axis=0)
    now = at - order
    best = _strongest_lag(slopes, pokes, now, lags)
    middle = at.size // 2
    parts = [slice(0, middle), slice(middle, at.size)]
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
    few = np.ascontiguousarray(slopes[:, :: max(1, slopes.shape[1] // _SAMPLE)])
    return int(np.argmax([np.square(few.T @ pokes[now - lag]).sum() for lag in range(lags)]))


def _matrix(slopes: NDArray[np.float32], pokes: NDArray[np.float32]) -> NDArray[np.float32]:
    """Least squares ``(n_modes, n_slopes)``."""
    gram = (pokes.T @ pokes).astype(np.float64)
    # So little that it only matters where a mode was hardly poked at all.
    gram[np.diag_indices_from(gram)] += 1e-9 * np.trace(gram) / len(gram)
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
    return weights / total, bread @ (scores @ scores.T) @ bread / total**2
