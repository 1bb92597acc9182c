"""Standard error of the mean of a series whose values are correlated in time."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

#: Fewer values do not tell how they are correlated.
LEAST = 10
#: Statistical error of the window over its systematic one (Wolff 2004, S).
_BALANCE = 1.5
#: The window spans at least the root of so many times the length: the values of short series seem less
#: correlated than they are. Found on loops of known scatter (docs/decisions/0013-strehl-errors.md).
_ROOT = 3.0
#: The error is not stated below the root of this share of that of uncorrelated values.
_LEAST_SHARE = 0.5


def standard_error(series: NDArray[np.floating]) -> float:
    """Standard error of the mean of a stationary series.

    ``sigma^2 = (C_0 + 2 sum over k up to W of (1 - k/n) C_k) / n`` with the autocovariances ``C_k``.
    The window W is chosen so that what it cuts off and what it adds in noise are balanced (Wolff 2004,
    Comput. Phys. Commun. 156, 143, eq. 52). About the series' own mean, every autocovariance comes out
    too small by ``sigma^2``, which is solved for.

    Parameters
    ----------
    series
        Values in their order ``(n,)``.

    Returns
    -------
    float
        NaN for fewer than :data:`LEAST` values.
    """
    n = series.size
    if n < LEAST:
        return math.nan
    covariance = _autocovariance(series - series.mean())
    if not covariance[0] > 0:
        return 0.0
    window = min(max(_window(covariance), int(math.sqrt(_ROOT * n))), n // 3)
    k = np.arange(1, window + 1)
    total = float(covariance[0] + 2 * ((1 - k / n) * covariance[1 : window + 1]).sum())
    freedom = n - (2 * window + 1) + window * (window + 1) / n
    # That the sum comes out near zero or below is chance; values that alternate so well are none of ours.
    return math.sqrt(max(total, _LEAST_SHARE * float(covariance[0])) / freedom)


def _autocovariance(centred: NDArray[np.floating]) -> NDArray[np.float64]:
    """Autocovariance by lag ``(n,)``."""
    n = centred.size
    transform = np.fft.rfft(centred, 2 * n)
    products = np.fft.irfft(transform * transform.conj(), 2 * n)[:n]
    return np.asarray(products / np.arange(n, 0, -1))


def _window(covariance: NDArray[np.float64]) -> int:
    """Lag up to which autocovariances count."""
    n, time = covariance.size, 0.5
    for lag in range(1, n // 3):
        time += covariance[lag] / covariance[0]
        decay = 1e-9 if time <= 0.5 else _BALANCE / math.log((2 * time + 1) / (2 * time - 1))
        if math.exp(-lag / decay) < decay / math.sqrt(lag * n):
            return lag
    return n // 3
