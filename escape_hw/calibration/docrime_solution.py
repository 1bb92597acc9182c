"""What DO-CRIME found."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.brief import brief
from escape_hw.api.results import TemporalResponse


@dataclass(frozen=True, slots=True, eq=False)
class DocrimeSolution:
    """A solved DO-CRIME run.

    Parameters
    ----------
    matrix, sigma
        ``(n_slopes, n_modes)``: slopes per unit mode, and standard errors of single elements beside a
        gain that they share.
    covariance
        Covariance of one frame's filtered residual slopes ``(n_slopes, n_slopes)``; ``None`` where
        correlations were not asked for.
    gram
        Sum over frames of filtered pokes times filtered pokes ``(n_modes, n_modes)``; in closed loop
        what stands in its place: the inverse of the covariance of a row of the matrix, per variance of
        its slope's noise.
    variance
        Variance of each slope's filtered noise, with what its correlation over time adds ``(n_slopes,)``.
    whitener
        The filter used, ``[1]`` for the plain estimator.
    gain_sigma
        Relative standard error of the gain that all elements share: an error of the temporal response,
        which is scaled to sum 1, scales the whole matrix.
    response_covariance
        Of the response's weights ``(lags, lags)``.
    """

    matrix: NDArray[np.float64]
    sigma: NDArray[np.float64]
    response: TemporalResponse
    covariance: NDArray[np.float64] | None
    gram: NDArray[np.float64]
    variance: NDArray[np.float64]
    whitener: NDArray[np.float64]
    frames: int
    lost_frames: int
    gain_sigma: float
    response_covariance: NDArray[np.float64]
    __repr__ = brief
