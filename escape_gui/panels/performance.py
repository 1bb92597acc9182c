"""Strehl ratio and residual over the last minutes and hours."""

from __future__ import annotations

import time
from typing import ClassVar

import numpy as np

from escape_gui.client.availability import UNKNOWN_VALUE
from escape_gui.panels.base import Context, ExportArray, Panel
from escape_gui.panels.psf import NO_REFERENCE, NO_REFERENCE_TIP
from escape_gui.widgets.controls import Readout, SegmentedButton, caption, row
from escape_gui.widgets.plots import StripChart
from escape_hw.remote.source import DataSource
from escape_hw.remote.state import State

#: Time spans to choose from, seconds.
SPANS_S = {"2 min": 120.0, "20 min": 1200.0, "2 h": 7200.0, "12 h": 43200.0}


class PerformancePanel(Panel):
    """Strip charts of Strehl ratio and residual, with the latest values."""

    name: ClassVar[str] = "performance"
    title: ClassVar[str] = "Performance"
    help: ClassVar[str] = (
        "Strehl ratio of the science camera (peak relative to the reference PSF), and residual wavefront of "
        "the controlled modes, over the last 2 minutes to 12 hours. They are recorded while the window is "
        "open, also while this panel is hidden. Gaps: the loop was open, or there is no reference PSF."
    )
    rate_hz: ClassVar[float] = 10.0
    placeholder: ClassVar[str] = (
        "The loop has not been closed yet.\nCalibrate first, then choose a matrix under Loop and close it."
    )

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        theme = context.theme
        self.strehl = StripChart(theme, "Strehl ratio over time", "Strehl ratio [%]", number=0)
        self.residual = StripChart(theme, "Residual over time", "residual [nm rms]", number=1)
        self.residual.setXLink(self.strehl)
        self.strehl.hide_bottom_label()
        self.readouts = {
            "strehl": Readout(theme, "Strehl", "%", 12),
            "residual": Readout(theme, "residual", "nm rms", 7),
        }
        self.reference_missing_label = caption(f"{NO_REFERENCE}: run Model PSF")
        # In two lines where there is little room; the newest values stay visible.
        self.reference_missing_label.setWordWrap(True)
        self.reference_missing_label.setToolTip(NO_REFERENCE_TIP)
        self.reference_missing_label.hide()
        self.span = SegmentedButton("Time span", tuple(SPANS_S), ["Show the last time span"] * len(SPANS_S))
        self.span.chosen.connect(self._on_span_chosen)
        self.body.addLayout(row(*self.readouts.values(), None, spacing=24))
        self.body.addLayout(row(self.span, (self.reference_missing_label, 1), None))
        self.body.addWidget(self.strehl, 1)
        self.body.addWidget(self.residual, 1)
        self._last_drawn_s = 0.0

    def _on_span_chosen(self, name: str) -> None:
        for chart in (self.strehl, self.residual):
            chart.set_span(SPANS_S[name])
        self._last_drawn_s = 0.0

    def on_state(self, state: State) -> None:
        history, loop = self.context.session.history, state.loop
        history.update(state)
        self.show_placeholder(not history.has_data)
        strehl = loop.strehl if loop.closed else None
        sigma = "" if loop.strehl_sigma is None else f" ± {100 * loop.strehl_sigma:.1f}"
        self.readouts["strehl"].show_value(UNKNOWN_VALUE if strehl is None else f"{100 * strehl:.1f}{sigma}")
        has_reference = any(stream.name == "model_psf" for stream in state.streams)
        self.reference_missing_label.setVisible(loop.closed and strehl is None and not has_reference)
        measured = loop.closed and loop.residual_nm > 0
        self.readouts["residual"].show_value(f"{loop.residual_nm:.1f}" if measured else UNKNOWN_VALUE)

    def tick(self, source: DataSource) -> None:
        now, history = time.monotonic(), self.context.session.history
        # Hours are drawn once a second.
        if self.shows_placeholder or (self.strehl.span_s > 120 and now - self._last_drawn_s < 1.0):
            return
        self._last_drawn_s = now
        self.strehl.show_history(history.strehl, now)
        self.residual.show_history(history.residual, now)

    def reset(self) -> None:
        """The history survives the end of an engine and a reconnection."""
        super().reset()
        self.show_placeholder(not self.context.session.history.has_data)

    def export_arrays(self) -> tuple[ExportArray, ...]:
        """One table of both curves; times in seconds before now."""
        if self.shows_placeholder:
            return ()
        history = self.context.session.history
        (times, strehl), (_, residual) = history.strehl.arrays, history.residual.arrays
        table = np.stack([times - time.monotonic(), strehl, residual], axis=1)
        return (ExportArray("performance", table, "", ("time [s]", "strehl [%]", "residual [nm rms]")),)
