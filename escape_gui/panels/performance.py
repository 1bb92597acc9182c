"""Strehl ratio and residual over the last minutes."""

from __future__ import annotations

import time
from typing import ClassVar

import numpy as np

from escape_gui.panels.base import Context, ExportArray, Panel
from escape_gui.panels.psf import NO_REFERENCE, NO_REFERENCE_TIP
from escape_gui.widgets.controls import Readout, caption, row
from escape_gui.widgets.plots import StripChart, TimeSeriesBuffer
from escape_hw.remote.source import DataSource
from escape_hw.remote.state import State

_BUFFER_SIZE = 4096
#: Interval between two states from which the curves have a gap, seconds.
_GAP_S = 2.0


class PerformancePanel(Panel):
    """Strip charts of Strehl ratio and residual, with the latest values."""

    name: ClassVar[str] = "performance"
    title: ClassVar[str] = "Performance"
    help: ClassVar[str] = (
        "Strehl ratio of the science camera (peak relative to the reference PSF), and residual wavefront of "
        "the controlled modes, over the last two minutes. Gaps: the panel was hidden, the loop was open, or "
        "there is no reference PSF."
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
        self.reference_missing_label = caption(NO_REFERENCE)
        self.reference_missing_label.setToolTip(NO_REFERENCE_TIP)
        self.reference_missing_label.hide()
        self.body.addLayout(row(*self.readouts.values(), self.reference_missing_label, None, spacing=24))
        self.body.addWidget(self.strehl, 1)
        self.body.addWidget(self.residual, 1)
        self._history = {"strehl": TimeSeriesBuffer(_BUFFER_SIZE), "residual": TimeSeriesBuffer(_BUFFER_SIZE)}
        self._last_state_s = time.monotonic()

    def on_state(self, state: State) -> None:
        loop, now = state.loop, time.monotonic()
        if loop.closed:
            self.show_placeholder(False)
        if self.shows_placeholder:
            return
        strehl = np.nan if loop.strehl is None or not loop.closed else 100 * loop.strehl
        # Zero until the first measurement after closing.
        residual = loop.residual_nm if loop.closed and loop.residual_nm > 0 else np.nan
        if now - self._last_state_s > _GAP_S:
            for history in self._history.values():
                history.add(now, np.nan)
        self._last_state_s = now
        self._history["strehl"].add(now, strehl)
        self._history["residual"].add(now, residual)
        sigma = "" if loop.strehl_sigma is None else f" ± {100 * loop.strehl_sigma:.1f}"
        self.readouts["strehl"].show_value("–" if np.isnan(strehl) else f"{strehl:.1f}{sigma}")
        has_reference = any(stream.name == "model_psf" for stream in state.streams)
        self.reference_missing_label.setVisible(loop.closed and bool(np.isnan(strehl)) and not has_reference)
        self.readouts["residual"].show_value("–" if np.isnan(residual) else f"{residual:.1f}")

    def tick(self, source: DataSource) -> None:
        if not self.shows_placeholder:
            now = time.monotonic()
            self.strehl.show_history(self._history["strehl"], now)
            self.residual.show_history(self._history["residual"], now)

    def clear(self) -> None:
        for history in self._history.values():
            history.clear()

    def export_arrays(self) -> tuple[ExportArray, ...]:
        """One table of both curves; times in seconds before now."""
        if self.shows_placeholder:
            return ()
        times, strehl = self._history["strehl"].arrays
        _, residual = self._history["residual"].arrays
        table = np.stack([times - time.monotonic(), strehl, residual], axis=1)
        return (ExportArray("performance", table, "", ("time [s]", "strehl [%]", "residual [nm rms]")),)
