"""Histograms of durations, and latency and jitter of a loop."""

from __future__ import annotations

import math
from array import array
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

#: Bins per octave: the width of a bin is 1/32 to 1/16 of its value, so its centre is accurate to 3 %.
PER_OCTAVE = 16
_MIN_BITS = 5
#: Up to 2**40 ns, about 18 minutes; longer durations count in the last bin.
BINS = (40 - _MIN_BITS + 2) * PER_OCTAVE


def bin_of(nanoseconds: int) -> int:
    """Index of the bin of a duration; below 16 ns each value has its own bin."""
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


#: Centre of each bin in nanoseconds ``(BINS,)``.
MIDDLES = _middles()


def percentiles_of(counts: ArrayLike, shares: ArrayLike) -> NDArray[np.float64]:
    """Percentiles of a histogram in nanoseconds, by the nearest rank; NaN when it is empty.

    Parameters
    ----------
    counts
        Count by bin ``(BINS,)``.
    shares
        Percentiles, 0 to 100.
    """
    above = np.cumsum(np.asarray(counts, dtype=np.float64))
    wanted = np.asarray(shares, dtype=np.float64) / 100
    if above[-1] == 0:
        return np.full(wanted.shape, math.nan)
    return np.asarray(MIDDLES[np.searchsorted(above, np.maximum(wanted * above[-1], 0.5))])


class Histogram:
    """Histogram of durations with logarithmic bins."""

    def __init__(self) -> None:
        self.counts = array("Q", bytes(8 * BINS))
        self.largest = 0
        self.total = 0

    def add(self, nanoseconds: int) -> None:
        """Count one duration."""
        self.counts[bin_of(nanoseconds)] += 1
        self.total += 1
        if nanoseconds > self.largest:
            self.largest = nanoseconds

    def percentiles(self, *shares: float) -> tuple[float, ...]:
        """Percentiles in microseconds; NaN when empty."""
        return tuple((percentiles_of(np.array(self.counts), shares) / 1e3).tolist())

    def deviation_percentile(self, share: float) -> float:
        """Percentile of the absolute deviation from the median, in microseconds; NaN when empty."""
        counts = np.array(self.counts, np.float64)
        if not counts.any():
            return math.nan
        off = np.abs(MIDDLES - percentiles_of(counts, 50))
        order = np.argsort(off)
        above = np.cumsum(counts[order])
        return float(off[order][np.searchsorted(above, share / 100 * above[-1])]) / 1e3


#: Frames whose times are stored exactly: one second of them up to this rate.
_RECENT = 4096


@dataclass(frozen=True, slots=True)
class TimingSummary:
    """Times in microseconds; NaN where there were no frames.

    Parameters
    ----------
    p50, p99, largest
        Time from frame received to command sent.
    jitter_p99
        99th percentile of the deviation of the frame interval from its median.
    """

    p50: float = math.nan
    p99: float = math.nan
    largest: float = math.nan
    jitter_p99: float = math.nan


class LoopTiming:
    """Latencies and frame intervals of a loop."""

    def __init__(self) -> None:
        self.latency, self.spacing = Histogram(), Histogram()
        self._began, self._took = array("q", bytes(8 * _RECENT)), array("q", bytes(8 * _RECENT))
        self._count = self._last = 0

    def add(self, began_ns: int, ended_ns: int) -> None:
        """Add a frame: time received and time answered, monotonic nanoseconds."""
        took, at = ended_ns - began_ns, self._count % _RECENT
        self._began[at], self._took[at] = began_ns, took
        self.latency.add(took)
        if self._count:
            self.spacing.add(began_ns - self._last)
        self._last = began_ns
        self._count += 1

    def recent(self) -> TimingSummary:
        """Summary of the last second, exact."""
        kept = min(self._count, _RECENT)
        order = np.arange(self._count - kept, self._count) % _RECENT
        began, took = np.array(self._began)[order], np.array(self._took)[order]
        new = began > self._last - 1e9
        if not new.any():
            return TimingSummary()
        p50, p99, largest = (np.percentile(took[new], [50, 99, 100]) / 1e3).tolist()
        spacing = np.diff(began[new])
        off = np.abs(spacing - np.median(spacing)) if spacing.size else np.array([math.nan])
        return TimingSummary(p50, p99, largest, float(np.percentile(off, 99)) / 1e3)

    def since_start(self) -> TimingSummary:
        """Summary of all frames; percentiles to about 3 %, smaller jitter counts as none."""
        p50, p99 = self.latency.percentiles(50, 99)
        return TimingSummary(p50, p99, self.latency.largest / 1e3, self.spacing.deviation_percentile(99))

    def histograms(self) -> NDArray[np.float32]:
        """Counts since the start ``(2, BINS)``: latency and frame interval."""
        return np.array([self.latency.counts, self.spacing.counts], np.float32)
