"""Whitening: a filter over time that takes out what the past predicts of the turbulence.

Pokes are independent of the past, so whatever the past predicts of the present slopes may be
subtracted without bias. The filter is the prediction-error filter of the slopes' own residuals
(feasible generalised least squares, Cochrane & Orcutt 1949); frame differencing is its simplest
case.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray


def fit_prediction_error_filter(
    residuals: NDArray[np.float32], present: NDArray[np.bool_], order: int
) -> NDArray[np.float64]:
    """Prediction-error filter common to all slopes.

    Least squares of every row on the rows before it, summed over the slopes, on rows whose past is
    complete (the covariance method: with turbulence this smooth, sums over unequal rows, as in the
    Yule-Walker equations, would spoil the filter as soon as frames are lost). One filter for all
    slopes keeps generalised and ordinary least squares equal across slopes, whatever their
    correlation (Zellner 1962: equal regressors).

    Parameters
    ----------
    residuals
        ``(n_times, n_slopes)``; rows where ``present`` is false are ignored.
    present
        ``(n_times,)``.
    order
        Number of past frames used.

    Returns
    -------
    ndarray, ``(order + 1,)``
        ``[1, -a_1, ..., -a_order]``.
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
    # A whisper of white noise keeps the system well conditioned when the slopes are noise-free.
    covariance[np.diag_indices(order + 1)] *= 1 + 1e-6
    return np.concatenate([[1.0], -np.linalg.solve(covariance[1:, 1:], covariance[1:, 0])])


def apply_filter(
    values: NDArray[np.floating], weights: NDArray[np.float64], at: NDArray[np.intp], column: int = 0
) -> NDArray[np.float32]:
    """Filtered rows ``sum_k weights[k] values[at - k]`` in single precision.

    Parameters
    ----------
    values
        ``(n_times, n)``.
    weights
        The filter, latest first.
    at
        Rows wanted; they rise. All rows between the first and the last are filtered, and those not
        wanted dropped.
    column
        First column wanted.

    Returns
    -------
    ndarray, ``(at.size, n - column)``
    """
    source = np.ascontiguousarray(values, dtype=np.float32)
    if not at.size:
        return np.empty((0, source.shape[1] - column), np.float32)
    first, n = int(at[0]), int(at[-1] - at[0]) + 1
    # Whole quads of taps: one pass over a row serves four.
    taps = np.zeros(-(-weights.size // 4) * 4, np.float32)
    taps[: weights.size] = weights
    out = np.empty((n, source.shape[1] - column), np.float32)
    _filter(source, taps, first, column, out)
    return out if n == at.size else out[at - first]


def fit_history_filters(
    residuals: NDArray[np.float32], present: NDArray[np.bool_], order: int
) -> list[NDArray[np.float64]]:
    """Prediction-error filters for every number of known past frames, ``order + 1`` of them.

    Each is scaled so that what it leaves has the variance of what the longest leaves: rows with a short
    past then stand beside the others with their due weight. Together they whiten a stretch of any
    length without giving up its first frames, as the Cholesky factor of its covariance over time would.

    Parameters
    ----------
    residuals, present, order
        As for :func:`fit_prediction_error_filter`.
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
    """How many frames in a row are known before each one, at most ``order``; -1 where the frame is lost."""
    history, running = np.full(present.size, -1, np.intp), 0
    for t in np.flatnonzero(present):
        running = running + 1 if t and present[t - 1] else 0
        history[t] = min(running, order)
    return history


def apply_history_filters(
    values: NDArray[np.floating], filters: list[NDArray[np.float64]], history: NDArray[np.intp]
) -> NDArray[np.float64]:
    """Rows filtered by as much past as they have, in time order ``(n_usable, n)``.

    Parameters
    ----------
    values
        ``(n_times, n)``.
    filters
        From :func:`fit_history_filters`; with more than one, rows without a past are left out.
    past
        From :func:`count_known_history`, no more than there are filters for.
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
        # Whole rows as slices, else the compiler does not see that it may take many columns at once.
        row = out[t]
        for k in range(0, taps.size, 4):
            a, b, c, d = taps[k], taps[k + 1], taps[k + 2], taps[k + 3]
            # Taps that only fill the last quad may reach before the first row; they weigh nothing.
            now = first + t - k
            va, vb = values[max(now, 0), column:], values[max(now - 1, 0), column:]
            vc, vd = values[max(now - 2, 0), column:], values[max(now - 3, 0), column:]
            if k == 0:
                for j in range(row.size):
                    row[j] = a * va[j] + b * vb[j] + c * vc[j] + d * vd[j]
            else:
                for j in range(row.size):
                    row[j] += a * va[j] + b * vb[j] + c * vc[j] + d * vd[j]
