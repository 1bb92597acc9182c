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


def prediction_error_filter(
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
    whole = np.ones(max(n - order, 0), np.bool_)
    for lag in range(order + 1):
        whole &= present[order - lag : n - lag]
    at = np.flatnonzero(whole) + order
    if at.size == 0:
        return np.asarray(np.eye(1, order + 1)[0])
    clean = residuals - residuals[at].mean(axis=0)
    past = np.stack([clean[at - lag].ravel() for lag in range(order + 1)]).astype(np.float64)
    covariance = past @ past.T
    if covariance[0, 0] <= 0:
        return np.asarray(np.eye(1, order + 1)[0])
    # A whisper of white noise keeps the system well conditioned when the slopes are noise-free.
    covariance[np.diag_indices(order + 1)] *= 1 + 1e-6
    return np.concatenate([[1.0], -np.linalg.solve(covariance[1:, 1:], covariance[1:, 0])])


def apply_filter(
    values: NDArray[np.floating], weights: NDArray[np.float64], at: NDArray[np.intp]
) -> NDArray[np.float32]:
    """Filtered rows ``sum_k weights[k] values[at - k]``, ``(at.size, n)`` in single precision.

    ``at`` rises; its unbroken stretches are filtered as slices, without index gathering.
    """
    source = np.ascontiguousarray(values, dtype=np.float32)
    out = np.empty((at.size, source.shape[1]), np.float32)
    breaks = np.flatnonzero(np.diff(at) != 1) + 1
    for start, end in zip([0, *breaks], [*breaks, at.size], strict=True):
        if end > start:
            _filter(source, weights.astype(np.float32), int(at[start]), out[start:end])
    return out


@njit(cache=True, fastmath=True, nogil=True)
def _filter(values, weights, first, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    for t in range(out.shape[0]):
        for j in range(out.shape[1]):
            out[t, j] = weights[0] * values[first + t, j]
        for k in range(1, weights.size):
            w = weights[k]
            if w != 0:
                for j in range(out.shape[1]):
                    out[t, j] += w * values[first + t - k, j]
