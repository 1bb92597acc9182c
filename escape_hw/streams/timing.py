"""Histograms of durations in fixed memory, and latency and jitter of a loop."""

from __future__ import annotations

import math
from array import array
from collections.abc import MutableSequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

#: Bins to each doubling: a bin is 1/16 to 1/32 of its value wide, so its middle is right within 3 %.
PER_OCTAVE = 16
_MIN_BITS = 5
#: Up to 2**40 ns, about 18 minutes; what is longer counts in the last bin.
BINS = (40 - _MIN_BITS + 2) * PER_OCTAVE


def bin_of(nanoseconds: int) -> int:
    """Number of the bin of a duration; those below 16 ns have a bin each."""
    if nanoseconds < PER_OCTAVE:
        return max(nanoseconds, 0)
    bits = nanoseconds.bit_length()
    number = ((bits - _MIN_BITS + 1) << 4) | ((nanoseconds >> (bits - _MIN_BITS)) & (PER_OCTAVE - 1))
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

    def deviation_percentile(self, share: float) -> float:
        """Percentile of how far durations depart from their median, in microseconds; NaN: nothing counted."""
        counts = np.array(self.counts, np.float64)
        if not counts.any():
            return math.nan
        off = np.abs(MIDDLES - percentiles_of(counts, 50))
        order = np.argsort(off)
        above = np.cumsum(counts[order])
        return float(off[order][np.searchsorted(above, share / 100 * above[-1])]) / 1e3


#: Frames whose times are kept exactly; a second of them up to this rate.
_RECENT = 4096


@dataclass(frozen=True, slots=True)
class TimingSummary:
    """Times in microseconds; NaN where there were no frames.

    Parameters
    ----------
    p50, p99, largest
        From a frame in hand to its command sent.
    jitter_p99
        99th percentile of how far the spacing of frames departs from its median.
    """

    p50: float = math.nan
    p99: float = math.nan
    largest: float = math.nan
    jitter_p99: float = math.nan


class LoopTiming:
    """Latencies of a loop and the spacing of its frames."""

    def __init__(self) -> None:
        self.latency, self.spacing = Histogram(), Histogram()
        self._began, self._took = array("q", bytes(8 * _RECENT)), array("q", bytes(8 * _RECENT))
        self._count = self._last = 0

    def add(self, began_ns: int, ended_ns: int) -> None:
        """Book a frame that was in hand at one time and answered at the other, on one monotonic clock."""
        took, at = ended_ns - began_ns, self._count % _RECENT
        self._began[at], self._took[at] = began_ns, took
        self.latency.add(took)
        if self._count:
            self.spacing.add(began_ns - self._last)
        self._last = began_ns
        self._count += 1

    def recent(self, seconds: float = 1.0) -> TimingSummary:
        """Of the frames of the last second, exactly."""
        kept = min(self._count, _RECENT)
        order = np.arange(self._count - kept, self._count) % _RECENT
        began, took = np.array(self._began)[order], np.array(self._took)[order]
        new = began > self._last - seconds * 1e9
        if not new.any():
            return TimingSummary()
        p50, p99, largest = (np.percentile(took[new], [50, 99, 100]) / 1e3).tolist()
        spacing = np.diff(began[new])
        off = np.abs(spacing - np.median(spacing)) if spacing.size else np.array([math.nan])
        return TimingSummary(p50, p99, largest, float(np.percentile(off, 99)) / 1e3)

    def since_start(self) -> TimingSummary:
        """Of all frames, the percentiles to about 3 %; what departs less than that counts as no jitter."""
        p50, p99 = self.latency.percentiles(50, 99)
        return TimingSummary(p50, p99, self.latency.largest / 1e3, self.spacing.deviation_percentile(99))

    def histograms(self) -> NDArray[np.float32]:
        """Counts since the start: latency, and spacing of frames ``(2, BINS)``."""
        return np.array([self.latency.counts, self.spacing.counts], np.float32)
