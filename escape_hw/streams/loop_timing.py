"""How regularly frames come and how soon they are answered: counted always, in memory that never grows."""

from __future__ import annotations

import math
from array import array
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from escape_hw.streams.histogram import Histogram

#: Frames whose times are kept exactly; a second of them up to this rate.
_RECENT = 4096


@dataclass(frozen=True, slots=True)
class Timing:
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

    def lately(self, seconds: float = 1.0) -> Timing:
        """Of the frames of the last second, exactly."""
        kept = min(self._count, _RECENT)
        order = np.arange(self._count - kept, self._count) % _RECENT
        began, took = np.array(self._began)[order], np.array(self._took)[order]
        new = began > self._last - seconds * 1e9
        if not new.any():
            return Timing()
        p50, p99, largest = (np.percentile(took[new], [50, 99, 100]) / 1e3).tolist()
        spacing = np.diff(began[new])
        off = np.abs(spacing - np.median(spacing)) if spacing.size else np.array([math.nan])
        return Timing(p50, p99, largest, float(np.percentile(off, 99)) / 1e3)

    def since_start(self) -> Timing:
        """Of all frames, the percentiles to about 3 %; what departs less than that counts as no jitter."""
        p50, p99 = self.latency.percentiles(50, 99)
        return Timing(p50, p99, self.latency.largest / 1e3, self.spacing.departure(99))

    def histograms(self) -> NDArray[np.float32]:
        """Counts since the start: latency, and spacing of frames ``(2, BINS)``."""
        return np.array([self.latency.counts, self.spacing.counts], np.float32)
