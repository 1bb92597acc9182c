"""Prediction-error filters that whiten the turbulence over time (Cochrane & Orcutt 1949).

Pokes are independent of the past, so the part of the present slopes that the past predicts is subtracted
without bias. The filter is estimated from the residuals of the slopes (feasible generalised least squares);
frame differencing is its simplest case.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray


def fit_prediction_error_filter(
    residuals: NDArray[np.float32], present: NDArray[np.bool_], order: int
) -> NDArray[np.float64]:
    """Estimate the prediction-error filter common to all slopes.

    Least squares of every row on the rows before it, summed over the slopes, on rows whose past is complete
    (covariance method). Sums over unequal rows, as in the Yule-Walker equations, would make the filter
    inaccurate when frames are lost, since turbulence is smooth. One filter for all slopes keeps generalised
    and ordinary least squares equal across slopes for any correlation (Zellner 1962: equal regressors).

    ``residuals``: ``(n_times, n_slopes)``; ``present``: ``(n_times,)``; rows where it is false are ignored.

    Returns ``[1, -a_1, ..., -a_order]``.
    """
    if order == 0:
        return np.ones(1)
    n = present.size
    complete = np.ones(max(n - order, 0), np.bool_)
    for lag in range(order + 1):
        complete &= present[order - lag : n - lag]
    at = np.flatnonzero(complete) + order
    if at.size == 0:
        return np.asarray(np.eye(1, order + 1)[0])
    centred = residuals - residuals[at].mean(axis=0)
    history = np.stack([centred[at - lag].ravel() for lag in range(order + 1)]).astype(np.float64)
    covariance = history @ history.T
    if covariance[0, 0] <= 0:
        return np.asarray(np.eye(1, order + 1)[0])
    # White noise that keeps the system well conditioned with noise-free slopes.
    covariance[np.diag_indices(order + 1)] *= 1 + 1e-6
    return np.concatenate([[1.0], -np.linalg.solve(covariance[1:, 1:], covariance[1:, 0])])


def apply_filter(
    values: NDArray[np.floating], weights: NDArray[np.float64], at: NDArray[np.intp], column: int = 0
) -> NDArray[np.float32]:
    """Filter rows in single precision: ``sum_k weights[k] values[at - k]``.

    Returns ``(at.size, n - column)``.

    Parameters
    ----------
    values
        ``(n_times, n)``.
    weights
        Filter, latest row first.
    at
        Indices of the rows to return, increasing. All rows between the first and the last are computed.
    """
    source = np.ascontiguousarray(values, dtype=np.float32)
    if not at.size:
        return np.empty((0, source.shape[1] - column), np.float32)
    first, n = int(at[0]), int(at[-1] - at[0]) + 1
    # A multiple of four taps, which one pass over a row applies together.
    taps = np.zeros(-(-weights.size // 4) * 4, np.float32)
    taps[: weights.size] = weights
    out = np.empty((n, source.shape[1] - column), np.float32)
    _filter(source, taps, first, column, out)
    return out if n == at.size else out[at - first]


def fit_history_filters(
    residuals: NDArray[np.float32], present: NDArray[np.bool_], order: int
) -> list[NDArray[np.float64]]:
    """Estimate prediction-error filters for 0 to ``order`` known past frames.

    Each is scaled so that its residuals have the variance of those of the longest filter, which gives rows
    with a short past their proper weight. Together they whiten a stretch of any length including its first
    frames, like the Cholesky factor of its covariance over time.
    """
    filters, residual_rms = [], []
    history = count_known_history(present, order)
    for k in range(order + 1):
        weights = fit_prediction_error_filter(residuals, present, k)
        at = np.flatnonzero(history >= k)
        errors = _filter_rows(residuals, weights, at)
        filters.append(weights)
        residual_rms.append(
            float(np.sqrt(np.square(errors - errors.mean(axis=0)).mean())) if at.size > 1 else 0.0
        )
    return [
        w * (residual_rms[-1] / rms if rms > 0 else 1.0) for w, rms in zip(filters, residual_rms, strict=True)
    ]


def count_known_history(present: NDArray[np.bool_], order: int) -> NDArray[np.intp]:
    """Number of consecutive frames known before each one, at most ``order``; -1 where the frame is lost."""
    history, running = np.full(present.size, -1, np.intp), 0
    for t in np.flatnonzero(present):
        running = running + 1 if t and present[t - 1] else 0
        history[t] = min(running, order)
    return history


def apply_history_filters(
    values: NDArray[np.floating], filters: list[NDArray[np.float64]], history: NDArray[np.intp]
) -> NDArray[np.float64]:
    """Filter each row with its known past rows; returns the usable rows in time order ``(n_usable, n)``.

    Parameters
    ----------
    values
        ``(n_times, n)``.
    filters
        Output of :func:`fit_history_filters`; with more than one, rows without a past are left out.
    history
        Output of :func:`count_known_history` for at most as many past frames.
    """
    usable = history >= min(1, len(filters) - 1)
    out = np.empty((history.size, values.shape[1]))
    for k, weights in enumerate(filters):
        at = np.flatnonzero(usable & (history == k))
        out[at] = _filter_rows(values, weights, at)
    return out[usable]


def _filter_rows(
    values: NDArray[np.floating], weights: NDArray[np.float64], at: NDArray[np.intp]
) -> NDArray[np.float64]:
    total = np.zeros((at.size, values.shape[1]))
    for lag, weight in enumerate(weights):
        total += weight * values[at - lag]
    return total


@njit(cache=True, fastmath=True, nogil=True)
def _filter(values, taps, first, column, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    for t in range(out.shape[0]):
        # Rows as slices, so that the compiler vectorises over columns.
        row = out[t]
        for k in range(0, taps.size, 4):
            a, b, c, d = taps[k], taps[k + 1], taps[k + 2], taps[k + 3]
            # Padding taps may refer to rows before the first; their weight is zero.
            now = first + t - k
            va, vb = values[max(now, 0), column:], values[max(now - 1, 0), column:]
            vc, vd = values[max(now - 2, 0), column:], values[max(now - 3, 0), column:]
            if k == 0:
                for j in range(row.size):
                    row[j] = a * va[j] + b * vb[j] + c * vc[j] + d * vd[j]
            else:
                for j in range(row.size):
                    row[j] += a * va[j] + b * vb[j] + c * vc[j] + d * vd[j]
