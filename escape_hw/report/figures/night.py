"""Performance, seeing, registration and optical gains over a night, and over nights."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime, timedelta

import numpy as np
from matplotlib.axes import Axes
from matplotlib.dates import AutoDateLocator, ConciseDateFormatter, date2num
from matplotlib.figure import Figure

from escape_hw.io.night_log import NightEntry
from escape_hw.report.figures import style

#: Panels of both figures: axis label and quantities.
PANELS: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("Strehl ratio [%]", ("strehl",)),
    ("D / r$_0$", ("strength",)),
    ("change of shift\n[% of a sub-aperture]", ("shift_x", "shift_y")),
    ("optical gain", ("optical_gain",)),
)
#: Interval between two samples from which a line has a gap.
_GAP = timedelta(minutes=2)
#: Quantities that are measured now and then rather than with every sample.
_SPARSE = ("shift_x", "shift_y", "optical_gain")
#: Quantities that are drawn relative to their first value.
_RELATIVE = ("shift_x", "shift_y")


def series(entries: Sequence[NightEntry], name: str) -> tuple[list[datetime], list[float]]:
    """Local times and values of a quantity."""
    known = [(entry.time.astimezone(), entry.values[name]) for entry in entries if name in entry.values]
    return [time for time, _ in known], [value for _, value in known]


def night_figure(entries: Sequence[NightEntry]) -> Figure | None:
    """One panel per quantity against local time, with faults, alarms and notes marked; ``None`` if empty."""
    panels = [panel for panel in PANELS if any(series(entries, name)[0] for name in panel[1])]
    if not panels:
        return None
    figure = style.new_figure(9.2, 0.6 + 1.45 * len(panels))
    axes = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    for panel, (label, names) in zip(axes, panels, strict=True):
        style.style_axes(panel).set_ylabel(label)
        for colour, name in zip(style.SERIES, names, strict=False):
            _draw_series(panel, entries, name, colour)
        if len(names) > 1:
            _legend_above(panel)
        for entry in entries:
            if entry.kind in ("fault", "alarm"):
                panel.axvline(entry.time.astimezone(), color=style.SERIES[5], lw=1.0)
            elif entry.kind == "note":
                panel.axvline(entry.time.astimezone(), color=style.MUTED, lw=0.8, ls=":")
    locator = AutoDateLocator(tz=entries[0].time.astimezone().tzinfo)  # type: ignore[no-untyped-call]
    axes[-1].xaxis.set_major_locator(locator)
    formatter = ConciseDateFormatter(locator, tz=locator.tz)  # type: ignore[no-untyped-call]
    axes[-1].xaxis.set_major_formatter(formatter)
    axes[-1].set_xlabel("local time; dotted: notes, red: faults and alarms")
    return figure


def _legend_above(panel: Axes) -> None:
    style.legend(panel, loc="lower right", bbox_to_anchor=(1, 0.98), ncols=2, borderpad=0)


def _draw_series(panel: Axes, entries: Sequence[NightEntry], name: str, colour: str) -> None:
    times, values = series(entries, name)
    label = name.removeprefix("shift_")
    if name in _RELATIVE and values:
        values = [value - values[0] for value in values]
    numbers = np.asarray(date2num(times), np.float64)  # type: ignore[no-untyped-call]
    if name in _SPARSE:
        sigma = [entry.values.get(f"{name}_sigma", np.nan) for entry in entries if name in entry.values]
        panel.errorbar(numbers, values, np.nan_to_num(sigma), fmt="o", ms=3, lw=1, color=colour, label=label)
        return
    drawn = np.array(values, float)
    gaps = np.flatnonzero(np.diff(numbers) > _GAP.total_seconds() / 86400) + 1
    panel.plot(np.insert(numbers, gaps, np.nan), np.insert(drawn, gaps, np.nan), color=colour, lw=1.1)


def summarise(entries: Sequence[NightEntry]) -> dict[str, tuple[float, float, float]]:
    """Median and percentiles 16 and 84 of every quantity of a night."""
    names = dict.fromkeys(name for _, names in PANELS for name in (*names, "r0_m", "seeing", "residual_nm"))
    found = {name: series(entries, name)[1] for name in names}
    return {
        name: tuple(float(one) for one in np.percentile(values, (50, 16, 84)))  # type: ignore[misc]
        for name, values in found.items()
        if values
    }


def nights_figure(nights: Mapping[str, Sequence[NightEntry]]) -> Figure | None:
    """Median and central 68 % of every quantity by night, the oldest first; ``None`` for fewer than two."""
    dates = sorted(nights)
    summaries = [summarise(nights[date]) for date in dates]
    panels = [panel for panel in PANELS if any(name in one for one in summaries for name in panel[1])]
    if len(dates) < 2 or not panels:
        return None
    figure = style.new_figure(9.2, 0.7 + 1.35 * len(panels))
    axes = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    for panel, (label, names) in zip(axes, panels, strict=True):
        style.style_axes(panel).set_ylabel(label)
        for colour, name in zip(style.SERIES, names, strict=False):
            known = [(k, one[name]) for k, one in enumerate(summaries) if name in one]
            x = [k for k, _ in known]
            median, low, high = np.array([value for _, value in known]).reshape(-1, 3).T
            errors = np.stack([median - low, high - median])
            if name in _RELATIVE and len(median):
                median = median - median[0]
            label = name.removeprefix("shift_")
            panel.errorbar(x, median, errors, fmt="o", ms=4, lw=1.2, color=colour, label=label)
        if len(names) > 1:
            _legend_above(panel)
    step = max(1, -(-len(dates) // 12))
    axes[-1].set_xticks(range(0, len(dates), step), dates[::step], rotation=30 if len(dates) > 6 else 0)
    axes[-1].set_xlim(-0.5, len(dates) - 0.5)
    return figure
