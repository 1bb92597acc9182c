"""Rates and intervals of the streams of this computer."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, field

from escape_hw.streams import segments
from escape_hw.streams.ring import RingReader, RingStats
from escape_hw.streams.segments import Segment, StreamUnavailable
from escape_hw.streams.timing import percentiles_of


@dataclass(frozen=True, slots=True)
class StreamStatus:
    """Status of one stream. Rate and percentiles cover the time since the previous call; NaN at first.

    Parameters
    ----------
    rate_hz, size
        Entries per second, and bytes of shared memory.
    age_s
        Seconds since the newest entry; NaN before the first.
    interval_us
        Median, 99th percentile and maximum of the interval between entries.
    """

    system: str
    stream: str
    segment: str
    pid: int
    alive: bool
    readers: tuple[int, ...]
    size: int
    written: int = 0
    shape: tuple[int, ...] = ()
    dtype: str = ""
    rate_hz: float = math.nan
    age_s: float = math.nan
    interval_us: tuple[float, float, float] = (math.nan, math.nan, math.nan)


@dataclass(slots=True)
class StreamMonitor:
    """Measures all streams of this user between two calls."""

    _previous: dict[str, RingStats] = field(default_factory=dict)

    def rows(self) -> tuple[StreamStatus, ...]:
        """Status of all streams, also of those whose process is dead."""
        found = segments.segments()
        users = segments.readers(one.name for one in found)
        now = {one.name: self._status(one, users) for one in found}
        self._previous = {name: seen for name, seen in self._previous.items() if name in now}
        return tuple(now.values())

    def _status(self, one: Segment, users: Mapping[str, tuple[int, ...]]) -> StreamStatus:
        common = (one.system, one.stream, one.name, one.pid, one.alive, users[one.name], one.size)
        try:
            with RingReader(one.name) as reader:
                stats = reader.stats()
        except StreamUnavailable:
            return StreamStatus(*common)
        before = self._previous.get(one.name)
        self._previous[one.name] = stats
        age = (time.monotonic_ns() - stats.arrived_ns) * 1e-9 if stats.written else math.nan
        rate = math.nan if before is None else _rate(before, stats)
        intervals = stats.intervals - (stats if before is None else before).intervals
        p50, p99, largest = (percentiles_of(intervals, [50, 99, 100]) / 1e3).tolist()
        return StreamStatus(*common, stats.written, stats.shape, stats.dtype, rate, age, (p50, p99, largest))


def _rate(before: RingStats, now: RingStats) -> float:
    """Entries per second by the entries' own times, since this process may be delayed."""
    entries, elapsed_ns = now.written - before.written, now.arrived_ns - before.arrived_ns
    return 1e9 * entries / elapsed_ns if entries and elapsed_ns > 0 else 0.0
