"""Whitening: a filter over time that takes out what the past predicts of the turbulence.

Pokes are independent of the past, so whatever the past predicts of the present slopes may be
subtracted without bias. The filter is the prediction-error filter of the slopes' own residuals
(feasible generalised least squares, Cochrane & Orcutt 1949); frame differencing is its simplest
case.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_toeplitz


def prediction_error_filter(
    residuals: NDArray[np.float32], present: NDArray[np.bool_], order: int
) -> NDArray[np.float64]:
    """Prediction-error filter common to all slopes.

    Solves the Yule-Walker equations for the autocovariance summed over the slopes. One filter for
    all slopes keeps generalised and ordinary least squares equal across slopes, whatever their
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
    clean = np.where(present[:, None], residuals, 0.0).astype(np.float64)
    clean -= np.where(present[:, None], clean.sum(axis=0) / present.sum(), 0.0)
    covariance = np.empty(order + 1)
    for lag in range(order + 1):
        both = present[lag:] & present[: present.size - lag]
        products = np.einsum("ts,ts->", clean[lag:][both], clean[: present.size - lag][both])
        covariance[lag] = products / max(int(both.sum()), 1)
    if covariance[0] <= 0:
        return np.eye(1, order + 1)[0]
    # A whisper of white noise keeps the system well conditioned when the slopes are noise-free.
    covariance[0] *= 1 + 1e-6
    return np.concatenate([[1.0], -solve_toeplitz(covariance[:-1], covariance[1:])])


def apply_filter(
    values: NDArray[np.floating], weights: NDArray[np.float64], at: NDArray[np.intp]
) -> NDArray[np.float64]:
    """Filtered rows ``sum_k weights[k] values[at - k]``, ``(at.size, ...)``."""
    out = weights[0] * values[at].astype(np.float64)
    for lag, weight in enumerate(weights[1:], start=1):
        out += weight * values[at - lag]
    return out
