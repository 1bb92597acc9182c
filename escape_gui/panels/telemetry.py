"""Recording of telemetry, and its analysis: residual by mode, spectra, gains, suspicious elements."""

from __future__ import annotations

import time
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from PySide6.QtWidgets import (
    QCheckBox,
    QComboBox,
    QPushButton,
    QSpinBox,
    QStackedWidget,
)

from escape_gui.client.availability import reason_no_change
from escape_gui.panels.base import Context, ExportArray, Panel
from escape_gui.views.telemetry import (
    ALL_MODES,
    Spectra,
    describe_analysis,
    describe_growth,
    suspicious_rows,
)
from escape_gui.widgets.browser_table import SortableCell, browser_table
from escape_gui.widgets.controls import SegmentedButton, caption, row, set_available, text_label
from escape_gui.widgets.inputs import ignore_wheel_without_focus
from escape_gui.widgets.telemetry_plot import GainByModePlot, ResidualPlot, SpectraPlot
from escape_hw.remote.source import DataSource
from escape_hw.remote.state import RecordingState, State

if TYPE_CHECKING:
    from escape_hw.pipeline.telemetry import TelemetryAnalysis

#: Seconds between two analyses of a recording that goes on.
_PERIOD_S = 3.0
VIEWS = {
    "Residual": "Residual of each mode, and the turbulence without correction",
    "Spectra": "Power spectra, and rejection of the loop",
    "Gains": "Gain of each mode: in use, and the one with the smallest residual",
    "Elements": "Actuators and sub-apertures whose telemetry differs from that of the others",
}
#: Choices of the spectra.
ONE_MODE, SLOPES = "one mode", "slopes"
SPECTRA = ("all modes", ONE_MODE, SLOPES)


class TelemetryPanel(Panel):
    """Controls of the recording above the views of its analysis."""

    name: ClassVar[str] = "telemetry"
    title: ClassVar[str] = "Telemetry"
    help: ClassVar[str] = (
        "Record telemetry at full rate for some seconds, or until stopped, and see its newest 8192 frames: "
        "residual by mode, spectra by Welch's method with the rejection of the integrator, gain by mode with "
        "the smallest residual (Gendron & Léna 1994, gain margin 2), suspicious actuators and sub-apertures. "
        "Without correction means the residual minus the commands that the sensor saw; the ratio of both "
        "follows the integrator unless commands were clipped or the delay is another one. Open… lists "
        "earlier ones. The analysis needs the files on this computer."
    )
    rate_hz: ClassVar[float] = 2.0

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self.analysis: TelemetryAnalysis | None = None
        self._folder: Path | None = None
        self._next: Path | None = None
        self._busy, self._analysed_s, self._recorded = False, 0.0, RecordingState()
        #: Recording whose end was noticed.
        self._ended_path = ""
        self._make_controls()
        theme = context.theme
        self.residual, self.spectra = ResidualPlot(theme), SpectraPlot(theme)
        self.gains, self.table = (
            GainByModePlot(theme),
            browser_table(("Element", "Place", "Reason"), "Suspicious actuators and sub-apertures"),
        )
        self.stack = QStackedWidget()
        for widget in (self.residual, self.spectra, self.gains, self.table):
            self.stack.addWidget(widget)
        self.kind = QComboBox()
        ignore_wheel_without_focus(self.kind)
        self.kind.addItems(SPECTRA)
        self.kind.setAccessibleName("Spectra to show")
        self.kind.currentIndexChanged.connect(self._on_view_chosen)
        self.mode = QSpinBox()
        ignore_wheel_without_focus(self.mode)
        self.mode.setRange(1, 1)
        self.mode.setAccessibleName("Mode of the spectra")
        self.mode.valueChanged.connect(self.redraw)
        self.view = SegmentedButton("View", tuple(VIEWS), list(VIEWS.values()))
        self.view.chosen.connect(self._on_view_chosen)
        self.source_label = caption()
        self.source_label.setWordWrap(True)
        self.message = text_label()
        self.message.hide()
        self.body.addLayout(row(self.record_button, self.seconds, self.images, None, self.browse_button))
        self.body.addWidget(self.growth)
        self.body.addLayout(row(self.view, None))
        self.body.addLayout(row(self.kind, self.mode, (self.source_label, 1)))
        self.body.addWidget(self.message)
        self.body.addWidget(self.stack, 1)
        self._on_view_chosen()
        self.setFocusProxy(self.record_button)

    def _make_controls(self) -> None:
        self.record_button = QPushButton("Record")
        self.record_button.clicked.connect(self._toggle_recording)
        self.seconds = QSpinBox()
        ignore_wheel_without_focus(self.seconds)
        self.seconds.setRange(0, 36_000)
        self.seconds.setValue(10)
        self.seconds.setSuffix(" s")
        self.seconds.setSpecialValueText("until stopped")
        self.seconds.setAccessibleName("Duration of the recording")
        self.seconds.setToolTip("Duration of the recording; 0: until stopped")
        self.images = QCheckBox("images")
        self.images.setToolTip("Record the frames of the cameras as well: most of the data")
        self.browse_button = QPushButton("Open…")
        self.browse_button.setToolTip("Browse the recordings: filter, open, delete")
        self.growth = caption()

    # ------------------------------------------------------------ recording
    def _toggle_recording(self) -> None:
        on = not self._recorded.recording
        seconds, images = float(self.seconds.value()) or None, self.images.isChecked()
        self.context.session.ask(
            "record telemetry" if on else "stop recording",
            lambda server: server.record(on, images=images, seconds=seconds),
        )

    def on_state(self, state: State) -> None:
        recording = self._recorded = state.recording
        on = recording.recording
        self.record_button.setText("Stop" if on else "Record")
        for widget in (self.seconds, self.images):
            widget.setEnabled(not on)
        self.growth.setText(("● " if on else "") + describe_growth(recording, _age_s(recording.started_utc)))
        # Also a recording that was made while this panel was hidden.
        has_ended = not on and bool(recording.path) and recording.path != self._ended_path
        self._ended_path = "" if on else recording.path
        if has_ended or (on and time.monotonic() - self._analysed_s > _PERIOD_S):
            self.open_recording(Path(recording.path))

    # ------------------------------------------------------------ analysis
    def open_recording(self, folder: Path) -> None:
        """Analyse the newest frames of a recording in a worker thread, and show them."""
        if self._busy:
            self._next = folder
            return
        self._busy, self._next, self._analysed_s = True, None, time.monotonic()
        self.context.session.compute(
            lambda: _analyse(folder), lambda found: self._on_analysed(folder, found), self._on_failed
        )

    def _on_analysed(self, folder: Path, analysis: TelemetryAnalysis) -> None:
        self._folder, self.analysis = folder, analysis
        self.mode.setRange(1, max(1, analysis.mode_psd.shape[1]))
        self.message.hide()
        self.redraw()
        self._open_next()

    def _on_failed(self, reason: str) -> None:
        self.message.setText(reason)
        # A recording that has just begun has no block on disk yet.
        self.message.setVisible(not self._recorded.recording)
        self._open_next()

    def _open_next(self) -> None:
        self._busy = False
        if self._next is not None:
            self.open_recording(self._next)

    def _on_view_chosen(self, *_: object) -> None:
        name = self.view.selected
        self.stack.setCurrentIndex(list(VIEWS).index(name))
        self.kind.setVisible(name == "Spectra")
        self.mode.setVisible(name == "Spectra" and self.kind.currentText() == ONE_MODE)
        self.redraw()

    def _spectra(self, analysis: TelemetryAnalysis) -> Spectra:
        kind = self.kind.currentText()
        return Spectra.of(analysis, self.mode.value() if kind == ONE_MODE else ALL_MODES, kind == SLOPES)

    def redraw(self) -> None:
        analysis = self.analysis
        if analysis is None:
            self.source_label.setText("Record, or open a recording, to see its analysis.")
            return
        self.source_label.setText(describe_analysis(analysis, self._folder))
        facts = analysis.facts
        self.source_label.setToolTip(
            f"{self._folder}\ngain {facts.gain:g}, leak {facts.leak:g}, "
            f"delay {facts.delay_frames:.3g} frames, {facts.rate_hz:g} Hz"
        )
        match self.view.selected:
            case "Residual":
                self.residual.show_modes(analysis.residual_rms_nm, analysis.open_loop_rms_nm)
            case "Spectra":
                self.spectra.show_spectra(self._spectra(analysis))
            case "Gains":
                self.gains.show_gains(analysis.facts.gain, analysis.optimal_gain, analysis.largest_gain)
            case _:
                self._fill_table(analysis)

    def _fill_table(self, analysis: TelemetryAnalysis) -> None:
        rows = suspicious_rows(analysis, self.bench_geometry) or [("none", "", "all elements are alike")]
        self.table.setRowCount(len(rows))
        for line, cells in enumerate(rows):
            for column, text in enumerate(cells):
                self.table.setItem(line, column, SortableCell(text, text))

    def tick(self, source: DataSource) -> None:
        # Here: a server that is lost sends no state.
        on = self._recorded.recording
        tip = "Stop the recording." if on else "Record slopes, residuals and commands at full rate."
        set_available(self.record_button, tip, reason_no_change(self.context.session.request_context))
        if not source.connected:
            self.growth.clear()

    def export_arrays(self) -> tuple[ExportArray, ...]:
        analysis = self.analysis
        if analysis is None:
            return ()
        spectra = Spectra.of(analysis, ALL_MODES)
        table = np.column_stack(
            [
                spectra.frequency_hz,
                analysis.slope_psd,
                spectra.residual,
                spectra.open_loop,
                analysis.rejection,
            ]
        )
        headings = ("frequency [Hz]", "slopes", "residual [nm2/Hz]", "open loop [nm2/Hz]", "rejection")
        found = [ExportArray("spectra", table, columns=headings)]
        if analysis.residual_rms_nm.size:
            modes = [np.arange(1, analysis.residual_rms_nm.size + 1), analysis.residual_rms_nm]
            names = ["mode", "residual [nm rms]"]
            if analysis.optimal_gain.size:
                modes += [analysis.open_loop_rms_nm, analysis.optimal_gain]
                names += ["open loop [nm rms]", "optimal gain"]
            found.append(ExportArray("modes", np.column_stack(modes), columns=tuple(names)))
        return tuple(found)


def _analyse(folder: Path) -> TelemetryAnalysis:
    """Load and analyse a recording; in a worker thread."""
    # Imported here: SciPy's filters take half a second, and the window appears before.
    from escape_hw.pipeline.telemetry import analyse
    from escape_hw.runtime.session.recordings import load_recording

    return analyse(*load_recording(folder))


def _age_s(started_utc: str) -> float:
    if not started_utc:
        return 0.0
    return (datetime.now(UTC) - datetime.fromisoformat(started_utc).replace(tzinfo=UTC)).total_seconds()
