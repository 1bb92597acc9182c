"""Root mean square, standard error of the mean of correlated series, intervals and paired comparisons."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special

#: Ratio of the standard deviation of a normal variable to its median absolute deviation.
NORMAL_RATIO = 1.4826
#: Fewest values from which a correlation is estimated.
MIN_SAMPLES = 10
#: Statistical error of the window over its systematic one (Wolff 2004, S).
_WOLFF_S = 1.5
#: The window is at least the root of this times the length, because the correlation of short series is
#: underestimated. Found on loops of known scatter (docs/decisions/0013-strehl-errors.md).
_MIN_WINDOW_FACTOR = 3.0
#: Lower limit of the variance, as a share of that of uncorrelated values.
_MIN_VARIANCE_FRACTION = 0.5


def root_mean_square(values: ArrayLike) -> float:
    """Root mean square of all values; NaN without values."""
    squares = np.square(values)
    return float(np.sqrt(np.mean(squares))) if squares.size else math.nan


def standard_error(series: NDArray[np.floating]) -> float:
    """Standard error of the mean of a stationary series.

    ``sigma^2 = (C_0 + 2 sum over k up to W of (1 - k/n) C_k) / n`` with the autocovariances ``C_k``. The
    window W balances truncation and statistical error (Wolff 2004, Comput. Phys. Commun. 156, 143, eq. 52).
    The bias of the autocovariances about the series' own mean, ``-sigma^2``, is corrected.

    ``series``: values in order ``(n,)``.

    Returns NaN for fewer than :data:`MIN_SAMPLES` values.
    """
    n = series.size
    if n < MIN_SAMPLES:
        return math.nan
    covariance = _autocovariance(series - series.mean())
    if not covariance[0] > 0:
        return 0.0
    window = min(max(_truncation_lag(covariance), int(math.sqrt(_MIN_WINDOW_FACTOR * n))), n // 3)
    k = np.arange(1, window + 1)
    total = float(covariance[0] + 2 * ((1 - k / n) * covariance[1 : window + 1]).sum())
    degrees_of_freedom = n - (2 * window + 1) + window * (window + 1) / n
    # A sum near zero or below is a statistical fluctuation.
    return math.sqrt(max(total, _MIN_VARIANCE_FRACTION * float(covariance[0])) / degrees_of_freedom)


def _autocovariance(centred: NDArray[np.floating]) -> NDArray[np.float64]:
    """Autocovariance by lag ``(n,)``."""
    n = centred.size
    transform = np.fft.rfft(centred, 2 * n)
    products = np.fft.irfft(transform * transform.conj(), 2 * n)[:n]
    return np.asarray(products / np.arange(n, 0, -1))


def _truncation_lag(covariance: NDArray[np.float64]) -> int:
    """Lag up to which autocovariances count."""
    n, time = covariance.size, 0.5
    for lag in range(1, n // 3):
        time += covariance[lag] / covariance[0]
        decay = 1e-9 if time <= 0.5 else _WOLFF_S / math.log((2 * time + 1) / (2 * time - 1))
        if math.exp(-lag / decay) < decay / math.sqrt(lag * n):
            return lag
    return n // 3


#: Fewest pairs, for an estimate of their scatter.
MIN_PAIRS = 6
#: Confidence level of all statements.
CONFIDENCE = 0.95


@dataclass(frozen=True, slots=True)
class MeanInterval:
    """Mean of ``n`` independent values, and its two-sided interval at :data:`CONFIDENCE`.

    The interval of one value is NaN.
    """

    mean: float
    low: float
    high: float
    n: int

    def __str__(self) -> str:
        if self.n < 2:
            return f"{self.mean:+.2f} (one value, no interval)"
        return f"{self.mean:+.2f}, {100 * CONFIDENCE:.0f} % interval {self.low:+.2f} to {self.high:+.2f}"


def mean_interval(values: NDArray[np.floating]) -> MeanInterval:
    """Mean of independent, normally distributed values ``(n,)`` with its interval by Student's t."""
    n, mean = values.size, float(values.mean())
    if n < 2:
        return MeanInterval(mean, math.nan, math.nan, n)
    half = float(special.stdtrit(n - 1, (1 + CONFIDENCE) / 2) * values.std(ddof=1) / math.sqrt(n))
    return MeanInterval(mean, mean - half, mean + half, n)


#: Resamples of a bootstrap.
_RESAMPLES = 20_000


@dataclass(frozen=True, slots=True)
class PairedComparison:
    """Mean difference A - B of pairs.

    Parameters
    ----------
    low, high
        Confidence interval of the mean, at :data:`CONFIDENCE`.
    equivalence
        Smallest margin x within which A and B are equivalent at :data:`CONFIDENCE` by two one-sided tests
        (Schuirmann 1987): the interval of twice the error probability lies within -x..x.
    """

    mean: float
    sigma: float
    low: float
    high: float
    equivalence: float
    pairs: int

    @property
    def is_different(self) -> bool:
        """Whether the interval excludes zero."""
        return self.low > 0 or self.high < 0

    def is_equivalent(self, margin: float) -> bool:
        """Whether A and B are equivalent within a margin."""
        return self.equivalence <= margin


def compare_pairs(
    first: NDArray[np.floating], second: NDArray[np.floating], seed: int = 0
) -> PairedComparison:
    """Compare two series pair by pair, by the studentised bootstrap (Efron & Tibshirani 1993, ch. 12.5).

    Resampled means are divided by their own standard errors, so that the intervals hold also for few pairs,
    for which plain percentiles are too narrow.

    ``first``, ``second``: values of A and B for the same turbulence ``(n,)``.

    Raises
    ------
    ValueError
        The series differ in length, or have fewer than :data:`MIN_PAIRS` values.
    """
    if first.shape != second.shape or first.ndim != 1 or first.size < MIN_PAIRS:
        raise ValueError(f"{first.shape} and {second.shape}: at least {MIN_PAIRS} pairs are needed")
    d = np.asarray(first, float) - np.asarray(second, float)
    n, mean = d.size, float(d.mean())
    sigma = float(d.std(ddof=1) / np.sqrt(n))
    if not sigma > 0:
        return PairedComparison(mean, 0.0, mean, mean, abs(mean), n)
    drawn = d[np.random.default_rng(seed).integers(0, n, (_RESAMPLES, n))]
    errors = drawn.std(axis=1, ddof=1) / np.sqrt(n)
    # A resample of equal values has no error of its own; with six pairs that is one in ten thousand.
    usable = errors > 1e-3 * sigma
    t = (drawn.mean(axis=1)[usable] - mean) / errors[usable]
    half, whole = (1 - CONFIDENCE) / 2, 1 - CONFIDENCE
    below, narrow_below, narrow_above, above = np.quantile(t, [half, whole, 1 - whole, 1 - half])
    low, high = mean - above * sigma, mean - below * sigma
    margin = max(abs(mean - narrow_above * sigma), abs(mean - narrow_below * sigma))
    return PairedComparison(mean, sigma, float(low), float(high), float(margin), n)


def describe_comparison(first: str, second: str, comparison: PairedComparison, margin: float) -> str:
    """Describe a comparison of Strehl ratios in a sentence, in percent.

    ``first``, ``second``: names of A and B; ``margin``: difference of the Strehl ratio within which they
    count as equivalent.
    """
    confidence = f"{100 * CONFIDENCE:.0f} %"
    mean, sigma, equivalence = 100 * comparison.mean, 100 * comparison.sigma, 100 * comparison.equivalence
    if comparison.is_equivalent(margin):
        return (
            f"{first} and {second} equivalent within {equivalence:.2f} % Strehl at {confidence} "
            f"(difference {mean:+.2f} ± {sigma:.2f} %)"
        )
    if comparison.is_different:
        better, worse = (first, second) if mean > 0 else (second, first)
        size = f"{abs(mean):.2f} ± {sigma:.2f} % Strehl"
        return f"{better} better than {worse} by {size} ({confidence}: {_interval(comparison)})"
    return (
        f"{first} against {second} undecided: {mean:+.2f} ± {sigma:.2f} % Strehl, equivalent only within "
        f"{equivalence:.2f} %; use more pairs"
    )


def _interval(comparison: PairedComparison) -> str:
    low, high = sorted((abs(comparison.low), abs(comparison.high)))
    return f"{100 * low:.2f} to {100 * high:.2f} %"
