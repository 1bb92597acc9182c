"""Performance, seeing, registration and optical gain over a night and over nights. No widgets."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from escape_hw.io.night_log import NightEntry


@dataclass(frozen=True, slots=True)
class Trend:
    """One plot: label of its axis, quantities, and whether they are drawn relative to their first value."""

    label: str
    names: tuple[str, ...]
    #: Measured now and then, and drawn as points with errors.
    points: bool = False
    relative: bool = False


TRENDS = (
    Trend("Strehl ratio [%]", ("strehl",)),
    Trend("D / r<sub>0</sub>", ("strength",)),
    Trend("Δ shift [% of sub-ap.]", ("shift_x", "shift_y"), points=True, relative=True),
    Trend("Optical gain", ("optical_gain",), points=True),
)
#: Interval between two samples from which a curve has a gap, seconds.
_GAP_S = 120.0


@dataclass(slots=True)
class TrendHistory:
    """Values of the samples of a night log, and times of notes, faults and alarms; seconds of Unix time."""

    _series: dict[str, list[tuple[float, float, float]]] = field(default_factory=dict)
    marks: list[tuple[float, str]] = field(default_factory=list)

    def add(self, entries: Iterable[NightEntry]) -> None:
        """Add entries, in their order."""
        for entry in entries:
            time = entry.time.timestamp()
            if entry.kind in ("note", "fault", "alarm"):
                self.marks.append((time, entry.kind))
            for name, value in entry.values.items():
                if not name.endswith("_sigma"):
                    sigma = entry.values.get(f"{name}_sigma", np.nan)
                    self._series.setdefault(name, []).append((time, value, sigma))

    def clear(self) -> None:
        """Discard everything."""
        self._series.clear()
        self.marks.clear()

    def last(self, name: str) -> float | None:
        """The newest value of a quantity."""
        series = self._series.get(name)
        return series[-1][1] if series else None

    def curve(self, trend: Trend, name: str, since: float) -> NDArray[np.float64]:
        """Times, values and standard errors ``(3, n)`` since a time; curves have NaN in gaps."""
        table = np.array(self._series.get(name, ()), float).reshape(-1, 3)
        table = table[table[:, 0] >= since]
        if trend.relative and len(table):
            table[:, 1] -= table[0, 1]
        if not trend.points and len(table):
            gaps = np.flatnonzero(np.diff(table[:, 0]) > _GAP_S) + 1
            table = np.insert(table, gaps, np.nan, axis=0)
        return table.T


def hour_ticks(start: float, end: float, most: int = 8) -> list[tuple[float, str]]:
    """At most ``most`` round local times between two times, for an axis: seconds of Unix time, ``21:30``."""
    steps = (300, 600, 1800, 3600, 7200, 10_800, 21_600)
    step = next((one for one in steps if (end - start) / one <= most), 43_200)
    offset = datetime.fromtimestamp(start).astimezone().utcoffset() or timedelta()
    first = -(-(start + offset.total_seconds()) // step) * step - offset.total_seconds()
    return [(at, f"{datetime.fromtimestamp(at):%H:%M}") for at in np.arange(first, end, step).tolist()]


def night_medians(
    nights: Mapping[str, Mapping[str, tuple[float, float, float]]], trend: Trend, name: str
) -> NDArray[np.float64]:
    """Number of the night, median and half of the central 68 % ``(3, n)``, from summaries by date."""
    dates = sorted(nights)
    rows = [(k, *nights[date][name]) for k, date in enumerate(dates) if name in nights[date]]
    table = np.array(rows, float).reshape(-1, 4)
    median = table[:, 1] - (table[0, 1] if trend.relative and len(table) else 0.0)
    return np.stack([table[:, 0], median, (table[:, 3] - table[:, 2]) / 2])


def read_summaries(
    runs: Path, system: str, tonight: Sequence[NightEntry], night: str
) -> dict[str, dict[str, tuple[float, float, float]]]:
    """Summaries of the last nights by date, those on this computer and tonight; in a worker thread."""
    # Imported here: Matplotlib takes half a second, and the window appears before.
    from escape_hw.report.figures.night import summarise
    from escape_hw.report.night_log import read_nights

    nights = {**read_nights(runs, system, night), night: tonight}
    return {date: summary for date, entries in nights.items() if (summary := summarise(entries))}
