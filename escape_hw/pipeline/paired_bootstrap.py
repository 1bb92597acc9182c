"""Two means over the same air compared: paired differences, their interval, and what may be said."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

#: Fewer pairs know too little of their own scatter.
LEAST_PAIRS = 6
#: Confidence of every statement.
CONFIDENCE = 0.95
_RESAMPLES = 20_000


@dataclass(frozen=True, slots=True)
class PairedComparison:
    """Mean difference A - B of pairs.

    Parameters
    ----------
    mean, sigma
        The mean and its standard error.
    low, high
        Confidence interval of the mean, at :data:`CONFIDENCE`.
    equivalence
        Smallest margin x within which A and B are equivalent at :data:`CONFIDENCE`: two one-sided tests
        (Schuirmann 1987), that is, the interval of twice the error probability lies within -x..x.
    pairs
        How many.
    """

    mean: float
    sigma: float
    low: float
    high: float
    equivalence: float
    pairs: int

    @property
    def differs(self) -> bool:
        """Whether the interval leaves zero out."""
        return self.low > 0 or self.high < 0

    def equivalent(self, margin: float) -> bool:
        """Whether A and B are shown to be equivalent within a margin."""
        return self.equivalence <= margin


def compare_pairs(
    first: NDArray[np.floating], second: NDArray[np.floating], seed: int = 0
) -> PairedComparison:
    """Compare two series pair by pair, by the studentised bootstrap (Efron & Tibshirani 1993, ch. 12.5).

    Resampled means are divided by their own standard errors, so that the intervals hold for few pairs,
    where plain percentiles are too narrow.

    Parameters
    ----------
    first, second
        Values of A and B on the same air ``(n,)``.
    seed
        Of the resampling.

    Raises
    ------
    ValueError
        Not as many of one as of the other, or fewer than :data:`LEAST_PAIRS`.
    """
    if first.shape != second.shape or first.ndim != 1 or first.size < LEAST_PAIRS:
        raise ValueError(f"{first.shape} and {second.shape}: at least {LEAST_PAIRS} pairs are needed")
    d = np.asarray(first, float) - np.asarray(second, float)
    n, mean = d.size, float(d.mean())
    sigma = float(d.std(ddof=1) / np.sqrt(n))
    if not sigma > 0:
        return PairedComparison(mean, 0.0, mean, mean, abs(mean), n)
    drawn = d[np.random.default_rng(seed).integers(0, n, (_RESAMPLES, n))]
    errors = drawn.std(axis=1, ddof=1) / np.sqrt(n)
    # A resample of one value alone knows no error of its own; with six pairs that is one in ten thousand.
    good = errors > 1e-3 * sigma
    t = (drawn.mean(axis=1)[good] - mean) / errors[good]
    half, whole = (1 - CONFIDENCE) / 2, 1 - CONFIDENCE
    below, narrow_below, narrow_above, above = np.quantile(t, [half, whole, 1 - whole, 1 - half])
    low, high = mean - above * sigma, mean - below * sigma
    margin = max(abs(mean - narrow_above * sigma), abs(mean - narrow_below * sigma))
    return PairedComparison(mean, sigma, float(low), float(high), float(margin), n)


def statement(first: str, second: str, found: PairedComparison, margin: float) -> str:
    """What may be said of two arms, in percent of the Strehl ratio.

    Parameters
    ----------
    first, second
        Names of A and B.
    found
        Their comparison.
    margin
        Difference in the Strehl ratio that does not matter.
    """
    sure = f"{100 * CONFIDENCE:.0f} %"
    size = f"{100 * abs(found.mean):.2f} ± {100 * found.sigma:.2f} % Strehl"
    if found.equivalent(margin):
        text = (
            f"{first} and {second} equivalent within {100 * found.equivalence:.2f} % Strehl at {sure} "
            f"(difference {100 * found.mean:+.2f} ± {100 * found.sigma:.2f} %)"
        )
    elif found.differs:
        better, worse = (first, second) if found.mean > 0 else (second, first)
        text = f"{better} better than {worse} by {size} ({sure}: {_interval(found)})"
    else:
        text = (
            f"{first} against {second} undecided: {100 * found.mean:+.2f} ± {100 * found.sigma:.2f} % "
            f"Strehl, equivalent only within {100 * found.equivalence:.2f} %; more pairs decide"
        )
    return text


def _interval(found: PairedComparison) -> str:
    low, high = sorted((abs(found.low), abs(found.high)))
    return f"{100 * low:.2f} to {100 * high:.2f} %"
