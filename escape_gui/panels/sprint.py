"""Convergence of SPRINT, drift of the registration during tracking, and the fitted mirror."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from PySide6.QtWidgets import QGridLayout, QLabel, QTabWidget, QWidget

from escape_gui.panels.base import Context, ExportArray, Panel
from escape_gui.views.convergence import NAMES, UNITS, ConvergenceHistory, RegistrationDrift, short_unit
from escape_gui.widgets.controls import (
    QUALITY_LEVELS,
    Level,
    StatusIndicator,
    TextArea,
    column,
    flat_button,
    row,
)
from escape_gui.widgets.plots import MARKERS, ConvergencePlot, DriftPlot
from escape_gui.widgets.profile_plot import ProfilePlot
from escape_hw.api.registration import PARAMETERS
from escape_hw.api.results import Estimate
from escape_hw.calibration.sprint.goodness_of_fit import NOT_JUDGED
from escape_hw.remote.source import Sample
from escape_hw.remote.state import State
from escape_hw.report.tables import format_with_error
from escape_hw.report.verdict import Quality, assess

#: Lines of warnings and notes that show at once: more would leave no room for the plot.
_NOTE_LINES = 6


class SprintPanel(Panel):
    """Three tabs: iterations of the fit, drift since the start of tracking, fitted influence functions."""

    name = "sprint"
    title = "Registration"
    help = (
        "Step norm of SPRINT and the five parameters of the registration by iteration, with the standard "
        "errors of the result. The second tab shows them over time while the tracker runs, the third one the "
        "profile of the influence functions that SPRINT has found."
    )
    streams: ClassVar[tuple[str, ...]] = (
        "registration", "registration_sigma", "step_norm", "registration_track",
    )  # fmt: skip
    rate_hz = 5.0
    placeholder = (
        "No registration yet.\n\nStart ESCAPE in the Procedure panel: SPRINT estimates the registration of "
        "the mirror. Or open a product or a run folder (Ctrl+O)."
    )

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._data: dict[str, NDArray[Any]] = {}
        self._document: Mapping[str, Any] = {}
        self._running = False
        self._last_result_id = -1
        self._history: ConvergenceHistory | None = None
        self.plot, self.drift = ConvergencePlot(context.theme), DriftPlot(context.theme)
        self.tabs = QTabWidget()
        self.tabs.setDocumentMode(True)
        self.tabs.addTab(self._make_convergence(), "Fit")
        self.tabs.addTab(self.drift, "Drift")
        self.profile = ProfilePlot(context.theme)
        self.tabs.addTab(self.profile, "Mirror")
        self.body.addWidget(self.tabs)
        self.setFocusProxy(self.units)

    def _make_convergence(self) -> QWidget:
        self._indicator = StatusIndicator(self.context.theme)
        tip = "Parameters in their physical units, or normalised on one axis (U)."
        self.units = flat_button("Units", tip, checkable=True)
        self.units.setShortcut("U")
        self.units.toggled.connect(self.plot.set_physical_units)
        self.tabs.setCornerWidget(self.units)
        table = QGridLayout()
        table.setHorizontalSpacing(5)
        table.setVerticalSpacing(0)
        self._markers = [QLabel(MARKERS[k][1]) for k in range(len(PARAMETERS))]
        self._values = [QLabel("–") for _ in PARAMETERS]
        self._words: list[QLabel] = []
        for k, (marker, value) in enumerate(zip(self._markers, self._values, strict=True)):
            self._words += [QLabel(NAMES[k]), QLabel(short_unit(UNITS[k]))]
            for at, widget in enumerate((marker, self._words[-2], value, self._words[-1])):
                table.addWidget(widget, k, at)
        table.setColumnStretch(3, 1)
        self._notes = TextArea(_NOTE_LINES)
        self._notes.hide()
        page = QWidget()
        column(
            row(self._indicator, None), (self.plot, 1), table, self._notes, parent=page, spacing=4
        ).setContentsMargins(0, 4, 0, 0)
        self.apply_theme()
        return page

    # ------------------------------------------------------------ data
    def on_state(self, state: State) -> None:
        """Take convergence and warnings from the result of a run that fitted or tracked a registration."""
        self._running = state.active_run is not None
        last = state.last_run
        if self._running:
            self._last_result_id = -1
        if last is None or last.id == self._last_result_id or self._running:
            return
        self._last_result_id = last.id
        fitted = last.document.get("registration") is not None and last.document.get("converged") is not None
        if fitted or last.document.get("track"):
            self._document, self.dirty = last.document, True

    def on_sample(self, stream: str, sample: Sample) -> None:
        self._data[stream] = sample.data
        self.dirty = True
        if self._running:
            self._document = {}
        if stream == "registration_track" and "registration" not in self._data:
            self.tabs.setCurrentIndex(1)

    def redraw(self) -> None:
        if self._data.get("registration", np.empty(0)).size:  # a fit begins without an iteration
            self._show_history()
        if "registration_track" in self._data:
            marks = [
                (float(one["seconds"]), "exchange")
                for one in self._document.get("exchanges") or ()
                if one.get("accepted")
            ]
            marks += [(float(one["seconds"]), "alarm") for one in self._document.get("alarms") or ()]
            self.drift.show_drift(RegistrationDrift.of(self._data["registration_track"], marks))

        self.profile.show_profile(self._document.get("influence_profile"))

    def _show_history(self) -> None:
        converged = self._document.get("converged")
        self._history = history = ConvergenceHistory.of(
            self._data["registration"], self._data.get("registration_sigma"), self._data.get("step_norm"),
            None if converged is None else bool(converged), self._document.get("model_fits"),
        )  # fmt: skip
        self.plot.show_convergence(history)
        verdict = assess(self._document)
        level = Level.ACTIVE if verdict is None else QUALITY_LEVELS[verdict.quality]
        self._indicator.set_status(level, history.headline())
        for k, label in enumerate(self._values):
            sigma = float(np.nan_to_num(history.sigma[k], posinf=0.0))
            label.setText(format_with_error(Estimate(float(history.values[-1, k]), sigma)))
        self._show_notes()

    def _show_notes(self) -> None:
        verdict = assess(self._document)
        warnings = [f"⚠ {one}" for one in self._document.get("warnings") or ()]
        if verdict is not None and verdict.quality is not Quality.GOOD:
            warnings.insert(0, str(verdict))
        notes = list(self._document.get("registration_notes") or ())
        if verdict is not None and "no standard errors" in verdict.reason:
            notes = [one for one in notes if one != NOT_JUDGED]
        self._notes.set_text("\n".join([*warnings, *notes]))
        colour = self.context.theme.colour("warn" if warnings else "muted").name()
        self._notes.label.setStyleSheet(f"color: {colour};")

    def clear(self) -> None:
        self._data.clear()
        self._history, self._document, self._last_result_id = None, {}, -1
        self.plot.show_convergence(None)
        self.drift.show_drift(RegistrationDrift.of(np.zeros((0, 11))))
        self.profile.show_profile(None)
        self.tabs.setCurrentIndex(0)

    def apply_theme(self) -> None:
        theme = self.context.theme
        for k, (marker, value) in enumerate(zip(self._markers, self._values, strict=True)):
            marker.setStyleSheet(f"color: {theme.series(k).name()};")
            value.setFont(theme.font(0.92, mono=True))
        # Five rows with their units fit the narrowest column.
        for label in self._words:
            label.setFont(theme.font(0.92))

    def export_arrays(self) -> tuple[ExportArray, ...]:
        """Parameters by iteration, and the track, in the paper's units."""
        arrays = []
        if self._history is not None:
            table = np.column_stack([self._history.iterations, self._history.step_norm, self._history.values])
            arrays.append(ExportArray("sprint", table, columns=("iteration", "step_norm", *PARAMETERS)))
        track = self._data.get("registration_track")
        if track is not None:
            drift = RegistrationDrift.of(track)
            columns = ("time", *PARAMETERS, *(f"{name}_sigma" for name in PARAMETERS))
            table = np.column_stack([track[:, 0], drift.values, drift.sigma])
            arrays.append(ExportArray("track", table, columns=columns))
        return tuple(arrays)
