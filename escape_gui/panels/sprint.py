"""How SPRINT converges, and how the registration drifts while it is tracked."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from PySide6.QtWidgets import QGridLayout, QHBoxLayout, QLabel, QPushButton, QTabWidget, QVBoxLayout, QWidget

from escape_gui.panels.base import Context, ExportArray, Panel
from escape_gui.views.convergence import NAMES, UNITS, ConvergenceHistory, RegistrationDrift, short_unit
from escape_gui.widgets.controls.status_indicator import Level, StatusIndicator
from escape_gui.widgets.plots.plot import MARKERS
from escape_gui.widgets.plots.registration import ConvergencePlot, DriftPlot
from escape_hw.api.registration import PARAMETERS
from escape_hw.api.results import Estimate
from escape_hw.remote.source import DataSource, Sample
from escape_hw.remote.state import State
from escape_hw.report.tables import format_with_error


class SprintPanel(Panel):
    """Two tabs: the fit's iterations, and the drift since tracking began."""

    name = "sprint"
    title = "Registration"
    help = (
        "SPRINT's step norm and the five parameters of the registration by iteration, with the standard "
        "errors of the result. The second tab follows them over time while the tracker runs."
    )
    streams: ClassVar[tuple[str, ...]] = (
        "registration", "registration_sigma", "step_norm", "registration_track",
    )  # fmt: skip
    rate_hz = 5.0
    placeholder = (
        "No registration yet.\n\nStart ESCAPE in the Procedure panel: SPRINT fits how the mirror sits on "
        "the sensor. Or open a product or a run folder (Ctrl+O)."
    )

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._data: dict[str, NDArray[Any]] = {}
        self._document: Mapping[str, Any] = {}
        self._running = self._dirty = False
        self._last_result_id = -1
        self._history: ConvergenceHistory | None = None
        self.plot, self.drift = ConvergencePlot(context.theme), DriftPlot(context.theme)
        self.tabs = QTabWidget()
        self.tabs.setDocumentMode(True)
        self.tabs.addTab(self._make_convergence(), "Fit")
        self.tabs.addTab(self.drift, "Drift")
        self.body.addWidget(self.tabs)
        self.setFocusProxy(self.units)

    def _make_convergence(self) -> QWidget:
        page = QWidget()
        column = QVBoxLayout(page)
        column.setContentsMargins(0, 4, 0, 0)
        self._indicator = StatusIndicator(self.context.theme)
        self.units = QPushButton("Units")
        self.units.setCheckable(True)
        self.units.setToolTip("Each kind of parameter in its own unit, or all on one axis (U).")
        self.units.setShortcut("U")
        self.units.toggled.connect(self.plot.set_physical_units)
        corner = QWidget()
        row = QHBoxLayout(corner)
        row.setContentsMargins(0, 0, 0, 2)
        row.addWidget(self._indicator)
        row.addWidget(self.units)
        self.tabs.setCornerWidget(corner)
        column.addWidget(self.plot, 1)
        self._table = QGridLayout()
        self._table.setHorizontalSpacing(8)
        self._table.setVerticalSpacing(0)
        self._markers = [QLabel(MARKERS[k][1]) for k in range(len(PARAMETERS))]
        self._values = [QLabel("–") for _ in PARAMETERS]
        for k, (sign, value) in enumerate(zip(self._markers, self._values, strict=True)):
            for at, widget in enumerate((sign, QLabel(NAMES[k]), value, QLabel(short_unit(UNITS[k])))):
                self._table.addWidget(widget, k, at)
        self._table.setColumnStretch(3, 1)
        column.addLayout(self._table)
        self._notes = QLabel()
        self._notes.setWordWrap(True)
        self._notes.hide()
        column.addWidget(self._notes)
        self.apply_theme()
        return page

    # ------------------------------------------------------------ data
    def on_state(self, state: State) -> None:
        """Whether it converged, and what there is to know of it, stands in the run's result.

        A run that fits no registration says nothing of it: the verdict on the one shown stays.
        """
        self._running = state.active_run is not None
        last = state.last_run
        if last is None or last.id == self._last_result_id or self._running:
            return
        self._last_result_id = last.id
        fitted = last.document.get("registration") is not None and last.document.get("converged") is not None
        if fitted or last.document.get("track"):
            self._document, self._dirty = last.document, True

    def on_sample(self, stream: str, sample: Sample) -> None:
        """Another iteration, or another second of tracking."""
        self._data[stream] = sample.data
        self._dirty = True
        if self._running:
            self._document = {}
        if stream == "registration_track" and "registration" not in self._data:
            self.tabs.setCurrentIndex(1)

    def tick(self, source: DataSource) -> None:
        """Draw when anything is new."""
        if not self._dirty:
            return
        self._dirty = False
        if "registration" in self._data:
            self._show_history()
        if "registration_track" in self._data:
            marks = [
                (float(one["seconds"]), "exchange")
                for one in self._document.get("exchanges") or ()
                if one.get("accepted")
            ]
            marks += [(float(one["seconds"]), "alarm") for one in self._document.get("alarms") or ()]
            self.drift.show_drift(RegistrationDrift.of(self._data["registration_track"], marks))

    def _show_history(self) -> None:
        converged = self._document.get("converged")
        self._history = ConvergenceHistory.of(
            self._data["registration"], self._data.get("registration_sigma"), self._data.get("step_norm"),
            None if converged is None else bool(converged),
        )  # fmt: skip
        self.plot.show_convergence(self._history)
        level = {None: Level.ACTIVE, True: Level.GOOD, False: Level.ERROR}[self._history.converged]
        self._indicator.set_status(level, self._history.headline())
        for k, label in enumerate(self._values):
            label.setText(
                format_with_error(
                    Estimate(float(self._history.values[-1, k]), _finite_or_zero(self._history.sigma[k]))
                )
            )
        self._show_notes()

    def _show_notes(self) -> None:
        warnings = [f"⚠ {one}" for one in self._document.get("warnings") or ()]
        notes = list(self._document.get("registration_notes") or ())
        self._notes.setText("\n".join([*warnings, *notes]))
        self._notes.setVisible(bool(warnings or notes))
        colour = self.context.theme.colour("warn" if warnings else "muted").name()
        self._notes.setStyleSheet(f"color: {colour};")

    def clear(self) -> None:
        """Forget the fit of another source."""
        self._data.clear()
        self._history, self._document, self._last_result_id = None, {}, -1
        self.plot.show_convergence(None)
        self.drift.show_drift(RegistrationDrift.of(np.zeros((0, 11))))
        self.tabs.setCurrentIndex(0)

    def apply_theme(self) -> None:
        """Signs in the curves' colours, numbers in letters that do not jitter."""
        theme = self.context.theme
        for k, (sign, value) in enumerate(zip(self._markers, self._values, strict=True)):
            sign.setStyleSheet(f"color: {theme.series(k).name()};")
            value.setFont(theme.font(mono=True))

    def export_arrays(self) -> tuple[ExportArray, ...]:
        """Parameters by iteration in the paper's units, and the track."""
        found = []
        if self._history is not None:
            table = np.column_stack([self._history.iterations, self._history.step_norm, self._history.values])
            found.append(ExportArray("sprint", table, columns=("iteration", "step_norm", *PARAMETERS)))
        track = self._data.get("registration_track")
        if track is not None:
            drift = RegistrationDrift.of(track)
            heads = ("time", *PARAMETERS, *(f"{name}_sigma" for name in PARAMETERS))
            found.append(
                ExportArray("track", np.column_stack([track[:, 0], drift.values, drift.sigma]), columns=heads)
            )
        return tuple(found)


def _finite_or_zero(sigma: float) -> float:
    return float(sigma) if np.isfinite(sigma) else 0.0
