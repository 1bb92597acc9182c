"""Trends of Strehl ratio, seeing, registration and optical gain over hours and nights."""

from __future__ import annotations

import time
from collections.abc import Callable
from datetime import UTC, datetime
from typing import ClassVar

from PySide6.QtGui import QResizeEvent

from escape_gui.client.availability import UNKNOWN_VALUE
from escape_gui.client.session import runs_folder
from escape_gui.panels.base import Context, ExportArray, Panel
from escape_gui.views.trends import TRENDS, TrendHistory, night_medians, read_summaries
from escape_gui.widgets.controls import Readout, SegmentedButton, caption, fit_height, row
from escape_gui.widgets.trend_plot import TrendsPlot
from escape_hw.io.night_log import NightEntry, night_of
from escape_hw.remote.source import DataSource

#: Time spans to choose from, seconds; 0: nights.
SPANS_S = {"1 h": 3600.0, "12 h": 43200.0, "Nights": 0.0}


class TrendsPanel(Panel):
    """Plots of the samples of the night log, and of the medians of the last nights."""

    name: ClassVar[str] = "trends"
    title: ClassVar[str] = "Trends"
    help: ClassVar[str] = (
        "Strehl ratio, strength of the turbulence, registration and optical gain over the night, or median "
        "and central 68 % of each of the last nights. The server records them, also while no window is open. "
        "D / r0 at the wavelength of the sensor is estimated from the modes of the loop (Noll 1976, without "
        "the first three radial orders): residual and commands, or in open loop the slopes and the last "
        "matrix. Shift and optical gain come from calibrations and from the tracker. Dotted lines are notes, "
        "red ones faults and alarms."
    )
    rate_hz: ClassVar[float] = 1.0
    placeholder: ClassVar[str] = (
        "No samples tonight.\n\nThe server records one every ten seconds while the loop is closed."
    )

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self.history = TrendHistory()
        self.readouts = {
            "strength": Readout(context.theme, "D / r₀", "", 6),
            "r0_m": Readout(context.theme, "r₀ at 500 nm", "", 8),
        }
        self.span = SegmentedButton(
            "Time span", tuple(SPANS_S), ["The last hour", "The last 12 hours", "The last nights"]
        )
        self.span.choose("12 h")
        self.span.chosen.connect(self._on_span_chosen)
        #: What is not measured, or what the nights show.
        self.missing = caption()
        self.plot = TrendsPlot(context.theme)
        self.body.addLayout(row(*self.readouts.values(), None, spacing=24))
        self.missing.setWordWrap(True)
        self.body.addLayout(row(self.span, None))
        self.body.addWidget(self.missing)
        self.body.addWidget(self.plot, 1)
        self._number = -1

    def tick(self, source: DataSource) -> None:
        new = source.night_after(self._number)
        if not new:
            return
        self._number = new[-1].number
        self.history.add(new)
        if any(entry.values for entry in new):
            self.show_placeholder(False)
        if not self.shows_placeholder and SPANS_S[self.span.selected]:
            self.dirty = True

    def redraw(self) -> None:
        for name, readout in self.readouts.items():
            value = self.history.last(name)
            readout.show_value(UNKNOWN_VALUE if value is None else _FORMATS[name](value))
        span_s = SPANS_S[self.span.selected]
        if not span_s:
            return
        now = time.time()
        curves = {
            name: self.history.curve(trend, name, now - span_s) for trend in TRENDS for name in trend.names
        }
        self.plot.show_hours(curves, self.history.marks, now - span_s, now)
        empty = [trend.names[0] for trend in TRENDS if not any(curves[name].size for name in trend.names)]
        self._show_missing("" if not empty else "not measured: " + ", ".join(_WORDS[one] for one in empty))

    def _show_missing(self, text: str) -> None:
        if text != self.missing.text():
            self.missing.setText(text)
            fit_height(self.missing)

    def resizeEvent(self, event: QResizeEvent) -> None:
        super().resizeEvent(event)
        fit_height(self.missing)

    def _on_span_chosen(self, name: str) -> None:
        self.dirty = bool(SPANS_S[name])
        if self.dirty:
            return
        session = self.context.session
        night, system, runs = night_of(datetime.now(UTC)), session.source.state.system, runs_folder(session)
        tonight = _of_night(session.source.night_after(-1), night)
        self._show_missing("Reading the nights…")
        session.compute(
            lambda: read_summaries(runs, system, tonight, night), self._show_nights, self._show_missing
        )

    def _show_nights(self, nights: dict[str, dict[str, tuple[float, float, float]]]) -> None:
        if SPANS_S[self.span.selected]:
            return
        self._show_missing(f"{len(nights)} nights: median and central 68 %")
        points = {name: night_medians(nights, trend, name) for trend in TRENDS for name in trend.names}
        self.plot.show_nights(points, sorted(nights))

    def clear(self) -> None:
        self.history.clear()
        self._number = -1

    def export_arrays(self) -> tuple[ExportArray, ...]:
        """A table per quantity; times in seconds of Unix time."""
        found = {name: self.history.curve(trend, name, 0.0) for trend in TRENDS for name in trend.names}
        return tuple(
            ExportArray(name, curve.T, "", ("time [s]", name, "sigma"))
            for name, curve in found.items()
            if curve.size
        )


_FORMATS: dict[str, Callable[[float], str]] = {
    "strength": "{:.3g}".format,
    "r0_m": lambda r0: f"{100 * r0:.3g} cm" if r0 > 0.01 else f"{1000 * r0:.3g} mm",
}
_WORDS = {
    "strehl": "Strehl ratio (no reference PSF)", "strength": "turbulence", "shift_x": "registration",
    "optical_gain": "optical gain",
}  # fmt: skip


def _of_night(entries: object, night: str) -> list[NightEntry]:
    return [entry for entry in entries if night_of(entry.time) == night]  # type: ignore[attr-defined]
