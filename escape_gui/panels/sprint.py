"""How SPRINT converges, and how the registration drifts while it is tracked."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from PySide6.QtWidgets import QGridLayout, QHBoxLayout, QLabel, QPushButton, QTabWidget, QVBoxLayout, QWidget

from escape_gui.panels.panel import Context, Panel, Shown
from escape_gui.views.convergence import NAMES, UNITS, Course, Drift, short_unit
from escape_gui.widgets.convergence_plot import ConvergencePlot
from escape_gui.widgets.curve_plot import MARKERS
from escape_gui.widgets.drift_plot import DriftPlot
from escape_gui.widgets.status_pill import Level, StatusPill
from escape_hw.api.registration import PARAMETERS
from escape_hw.api.results import Measured
from escape_hw.remote.source import Sample, Source
from escape_hw.remote.state import State
from escape_hw.report.tables import with_error


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
    empty = (
        "No registration yet.\n\nStart ESCAPE in the Procedure panel: SPRINT fits how the mirror sits on "
        "the sensor. Or open a product or a run folder (Ctrl+O)."
    )

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._data: dict[str, NDArray[Any]] = {}
        self._document: Mapping[str, Any] = {}
        self._running = self._dirty = False
        self._told = -1
        self._course: Course | None = None
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
        self._pill = StatusPill(self.context.theme)
        self.units = QPushButton("Units")
        self.units.setCheckable(True)
        self.units.setToolTip("Each kind of parameter in its own unit, or all on one axis (U).")
        self.units.setShortcut("U")
        self.units.toggled.connect(self.plot.use_units)
        corner = QWidget()
        row = QHBoxLayout(corner)
        row.setContentsMargins(0, 0, 0, 2)
        row.addWidget(self._pill)
        row.addWidget(self.units)
        self.tabs.setCornerWidget(corner)
        column.addWidget(self.plot, 1)
        self._table = QGridLayout()
        self._table.setHorizontalSpacing(8)
        self._table.setVerticalSpacing(0)
        self._signs = [QLabel(MARKERS[k][1]) for k in range(len(PARAMETERS))]
        self._values = [QLabel("–") for _ in PARAMETERS]
        for k, (sign, value) in enumerate(zip(self._signs, self._values, strict=True)):
            for at, widget in enumerate((sign, QLabel(NAMES[k]), value, QLabel(short_unit(UNITS[k])))):
                self._table.addWidget(widget, k, at)
        self._table.setColumnStretch(3, 1)
        column.addLayout(self._table)
        self._notes = QLabel()
        self._notes.setWordWrap(True)
        self._notes.hide()
        column.addWidget(self._notes)
        self.restyle()
        return page

    # ------------------------------------------------------------ data
    def take_state(self, state: State) -> None:
        """Whether it converged, and what there is to know of it, stands in the run's result.

        A run that fits no registration says nothing of it: the verdict on the one shown stays.
        """
        self._running = state.procedure is not None
        last = state.last
        if last is None or last.id == self._told or self._running:
            return
        self._told = last.id
        fitted = last.document.get("registration") is not None and last.document.get("converged") is not None
        if fitted or last.document.get("track"):
            self._document, self._dirty = last.document, True

    def take_sample(self, stream: str, sample: Sample) -> None:
        """Another iteration, or another second of tracking."""
        self._data[stream] = sample.data
        self._dirty = True
        if self._running:
            self._document = {}
        if stream == "registration_track" and "registration" not in self._data:
            self.tabs.setCurrentIndex(1)

    def tick(self, source: Source) -> None:
        """Draw when anything is new."""
        if not self._dirty:
            return
        self._dirty = False
        if "registration" in self._data:
            self._show_course()
        if "registration_track" in self._data:
            marks = [
                (float(one["seconds"]), "exchange")
                for one in self._document.get("exchanges") or ()
                if one.get("accepted")
            ]
            marks += [(float(one["seconds"]), "alarm") for one in self._document.get("alarms") or ()]
            self.drift.show_drift(Drift.of(self._data["registration_track"], marks))

    def _show_course(self) -> None:
        converged = self._document.get("converged")
        self._course = Course.of(
            self._data["registration"], self._data.get("registration_sigma"), self._data.get("step_norm"),
            None if converged is None else bool(converged),
        )  # fmt: skip
        self.plot.show_course(self._course)
        level = {None: Level.ACTIVE, True: Level.GOOD, False: Level.BAD}[self._course.converged]
        self._pill.show_condition(level, self._course.headline())
        for k, label in enumerate(self._values):
            label.setText(
                with_error(Measured(float(self._course.values[-1, k]), _error(self._course.sigma[k])))
            )
        self._say_notes()

    def _say_notes(self) -> None:
        warnings = [f"⚠ {one}" for one in self._document.get("warnings") or ()]
        notes = list(self._document.get("registration_notes") or ())
        self._notes.setText("\n".join([*warnings, *notes]))
        self._notes.setVisible(bool(warnings or notes))
        colour = self.context.theme.colour("warn" if warnings else "muted").name()
        self._notes.setStyleSheet(f"color: {colour};")

    def clear(self) -> None:
        """Forget the fit of another source."""
        self._data.clear()
        self._course, self._document, self._told = None, {}, -1
        self.plot.show_course(None)
        self.drift.show_drift(Drift.of(np.zeros((0, 11))))
        self.tabs.setCurrentIndex(0)

    def restyle(self) -> None:
        """Signs in the curves' colours, numbers in letters that do not jitter."""
        theme = self.context.theme
        for k, (sign, value) in enumerate(zip(self._signs, self._values, strict=True)):
            sign.setStyleSheet(f"color: {theme.series(k).name()};")
            value.setFont(theme.font(mono=True))

    def shown(self) -> tuple[Shown, ...]:
        """Parameters by iteration in the paper's units, and the track."""
        found = []
        if self._course is not None:
            table = np.column_stack([self._course.iterations, self._course.step_norm, self._course.values])
            found.append(Shown("sprint", table, columns=("iteration", "step_norm", *PARAMETERS)))
        track = self._data.get("registration_track")
        if track is not None:
            drift = Drift.of(track)
            heads = ("time", *PARAMETERS, *(f"{name}_sigma" for name in PARAMETERS))
            found.append(
                Shown("track", np.column_stack([track[:, 0], drift.values, drift.sigma]), columns=heads)
            )
        return tuple(found)


def _error(sigma: float) -> float:
    return float(sigma) if np.isfinite(sigma) else 0.0
