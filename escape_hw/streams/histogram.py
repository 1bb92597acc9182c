"""Counts of durations in bins of equal relative width: always on, fixed memory, any range."""

from __future__ import annotations

import math
from array import array
from collections.abc import MutableSequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

#: Bins to each doubling: a bin is 1/16 to 1/32 of its value wide, so its middle is right within 3 %.
PER_OCTAVE = 16
_LEAST_BITS = 5
#: Up to 2**40 ns, about 18 minutes; what is longer counts in the last bin.
BINS = (40 - _LEAST_BITS + 2) * PER_OCTAVE


def bin_of(nanoseconds: int) -> int:
    """Number of the bin of a duration; those below 16 ns have a bin each."""
    if nanoseconds < PER_OCTAVE:
        return max(nanoseconds, 0)
    bits = nanoseconds.bit_length()
    number = ((bits - _LEAST_BITS + 1) << 4) | ((nanoseconds >> (bits - _LEAST_BITS)) & (PER_OCTAVE - 1))
    return min(number, BINS - 1)


def _middles() -> NDArray[np.float64]:
    number = np.arange(BINS)
    shift = np.maximum(number // PER_OCTAVE - 1, 0)
    low = np.where(number < PER_OCTAVE, number, (PER_OCTAVE + number % PER_OCTAVE) << shift)
    return np.asarray(low + (np.exp2(shift) - 1) / 2)


#: Middle of each bin in nanoseconds ``(BINS,)``.
MIDDLES = _middles()


def percentiles_of(counts: ArrayLike, shares: ArrayLike) -> NDArray[np.float64]:
    """Percentiles in nanoseconds of what was counted, by the nearest rank; NaN when nothing was.

    Parameters
    ----------
    counts
        Count by bin ``(BINS,)``.
    shares
        Percentiles asked for, 0 to 100.
    """
    above = np.cumsum(np.asarray(counts, dtype=np.float64))
    wanted = np.asarray(shares, dtype=np.float64) / 100
    if above[-1] == 0:
        return np.full(wanted.shape, math.nan)
    return np.asarray(MIDDLES[np.searchsorted(above, np.maximum(wanted * above[-1], 0.5))])


class Histogram:
    """Durations counted in bins.

    Parameters
    ----------
    counts
        Where to count, :data:`BINS` integers of 64 bits; memory of its own by default.
    """

    def __init__(self, counts: MutableSequence[int] | None = None) -> None:
        self.counts: MutableSequence[int] = array("Q", bytes(8 * BINS)) if counts is None else counts
        self.largest = 0
        self.total = 0

    def add(self, nanoseconds: int) -> None:
        """Count one duration."""
        self.counts[bin_of(nanoseconds)] += 1
        self.total += 1
        if nanoseconds > self.largest:
            self.largest = nanoseconds

    def percentiles(self, *shares: float) -> tuple[float, ...]:
        """Percentiles in microseconds; NaN while nothing was counted."""
        return tuple((percentiles_of(np.array(self.counts), shares) / 1e3).tolist())

    def departure(self, share: float) -> float:
        """Percentile of how far durations depart from their median, in microseconds; NaN: nothing counted."""
        counts = np.array(self.counts, np.float64)
        if not counts.any():
            return math.nan
        off = np.abs(MIDDLES - percentiles_of(counts, 50))
        order = np.argsort(off)
        above = np.cumsum(counts[order])
        return float(off[order][np.searchsorted(above, share / 100 * above[-1])]) / 1e3
