"""How good the correction is: Strehl ratio and residual over the last minutes."""

from __future__ import annotations

import time
from typing import ClassVar

import numpy as np
from PySide6.QtWidgets import QHBoxLayout, QLabel

from escape_gui.panels.base import Context, ExportArray, Panel
from escape_gui.panels.psf import NO_MODEL, NO_MODEL_TIP
from escape_gui.widgets.controls.readout import Readout
from escape_gui.widgets.plots.strip_chart import StripChart, TimeSeriesBuffer
from escape_hw.remote.source import DataSource
from escape_hw.remote.state import State

_BUFFER_SIZE = 4096
#: Seconds between two states from which on there is a gap in the curves.
_GAP_S = 2.0


class PerformancePanel(Panel):
    """Two strip charts and their newest values."""

    name: ClassVar[str] = "performance"
    title: ClassVar[str] = "Performance"
    help: ClassVar[str] = (
        "Strehl ratio of the science camera by its peak against the model, and residual wavefront of the "
        "modes the loop controls, over the last two minutes. Gaps: the panel was "
        "hidden, the loop was open, or there is no model image."
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
        row = QHBoxLayout()
        row.setSpacing(24)
        for readout in self.readouts.values():
            row.addWidget(readout)
        self.model_missing_label = QLabel(NO_MODEL)
        self.model_missing_label.setObjectName("caption")
        self.model_missing_label.setToolTip(NO_MODEL_TIP)
        self.model_missing_label.hide()
        row.addWidget(self.model_missing_label)
        row.addStretch()
        self.body.addLayout(row)
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
        # None was measured yet in the moment of closing.
        residual = loop.residual_nm if loop.closed and loop.residual_nm > 0 else np.nan
        if now - self._last_state_s > _GAP_S:
            # Nobody looked meanwhile: no line leads across.
            for history in self._history.values():
                history.add(now, np.nan)
        self._last_state_s = now
        self._history["strehl"].add(now, strehl)
        self._history["residual"].add(now, residual)
        sigma = "" if loop.strehl_sigma is None else f" ± {100 * loop.strehl_sigma:.1f}"
        self.readouts["strehl"].show_value("–" if np.isnan(strehl) else f"{strehl:.1f}{sigma}")
        modelled = any(stream.name == "model_psf" for stream in state.streams)
        self.model_missing_label.setVisible(loop.closed and bool(np.isnan(strehl)) and not modelled)
        self.readouts["residual"].show_value("–" if np.isnan(residual) else f"{residual:.1f}")

    def tick(self, source: DataSource) -> None:
        if self.shows_placeholder:
            return
        now = time.monotonic()
        self.strehl.show_history(self._history["strehl"], now)
        self.residual.show_history(self._history["residual"], now)

    def clear(self) -> None:
        for history in self._history.values():
            history.clear()

    def export_arrays(self) -> tuple[ExportArray, ...]:
        if self.shows_placeholder:
            return ()
        times, strehl = self._history["strehl"].arrays
        _, residual = self._history["residual"].arrays
        table = np.stack([times - time.monotonic(), strehl, residual], axis=1)
        return (ExportArray("performance", table, "", ("time [s]", "strehl [%]", "residual [nm rms]")),)
