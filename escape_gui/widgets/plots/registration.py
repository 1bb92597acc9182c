"""Convergence of SPRINT by iteration, and drift of the registration over time."""

from __future__ import annotations

import numpy as np
import pyqtgraph as pg
from PySide6.QtWidgets import QVBoxLayout, QWidget

from escape_gui.theme import Theme
from escape_gui.views.convergence import GROUPS, NAMES, ConvergenceHistory, RegistrationDrift, short_unit
from escape_gui.widgets.plots.plot import ErrorBand, ErrorCurve, add_plot, clear, reference_line, style_axis

#: Width of the left axes at normal letter size, so that all plots begin at the same place.
LEFT_AXIS_WIDTH = 66


class ConvergencePlot(QWidget):
    """Step norm above; below, all parameters on one axis, or each kind in its own unit."""

    def __init__(self, theme: Theme) -> None:
        super().__init__()
        self._theme = theme
        self._history: ConvergenceHistory | None = None
        self._physical = False
        self._grid = pg.GraphicsLayoutWidget()
        layout = QVBoxLayout(self)
        layout.setContentsMargins(0, 0, 0, 0)
        layout.addWidget(self._grid)
        theme.changed.connect(self._build)
        self._build()

    @property
    def physical(self) -> bool:
        """Whether parameters are shown in their units; normalised otherwise."""
        return self._physical

    def set_physical_units(self, physical: bool) -> None:
        """Show parameters in their units, or all on one axis."""
        if physical != self._physical:
            self._physical = physical
            self._build()

    def show_convergence(self, history: ConvergenceHistory | None) -> None:
        """Show this one; ``None``: nothing yet."""
        self._history = history
        self._fill()

    def _build(self) -> None:
        """Make the plots again: other axes, other colours."""
        clear(self._grid)
        self._grid.setBackground(self._theme.colour("field"))
        self._curves: dict[int, ErrorCurve] = {}
        top = self._plot(0, "Step norm", "", last=False)
        top.setLogMode(y=True)
        self._norm = ErrorCurve.make(self._theme, 0)
        self._norm.add_to(top)
        self._marks = [reference_line(self._theme, 1, horizontal=False)]
        top.addItem(self._marks[0])
        groups = GROUPS if self._physical else (("Normalised", "", tuple(range(len(NAMES)))),)
        for row, (title, unit, members) in enumerate(groups, 1):
            plot = self._plot(row, title, short_unit(unit), last=row == len(groups))
            plot.setXLink(top)
            for member in members:
                self._curves[member] = ErrorCurve.make(self._theme, member)
                self._curves[member].add_to(plot)
            mark = reference_line(self._theme, 1, horizontal=False)
            plot.addItem(mark)
            self._marks.append(mark)
        rows = self._grid.ci.layout
        for row in range(len(groups) + 1):
            rows.setRowStretchFactor(row, 3 if row or self._physical else 2)
        self._top = top
        self._fill()

    def _plot(self, row: int, title: str, unit: str, *, last: bool) -> pg.PlotItem:
        plot = add_plot(self._grid, row)
        style_axis(self._theme, plot.getAxis("left"), title, unit, stacked=True)
        plot.getAxis("left").setWidth(self._theme.pixels(LEFT_AXIS_WIDTH))
        style_axis(self._theme, plot.getAxis("bottom"), "Iteration" if last else "")
        plot.getAxis("bottom").setStyle(showValues=last)
        return plot

    def _fill(self) -> None:
        history = self._history
        for mark in self._marks:
            mark.setVisible(history is not None and bool(history.converged))
        if history is None or not len(history.values):
            for curve in (self._norm, *self._curves.values()):
                curve.set(np.zeros(0), np.zeros(0), None)
            return
        drawn = history if self._physical else history.normalised()
        x = drawn.iterations
        self._norm.set(x, drawn.step_norm, None)
        for member, curve in self._curves.items():
            errors = np.full(x.size, np.nan)
            errors[-1] = drawn.sigma[member]
            curve.set(x, drawn.values[:, member], errors, cap=0.2)
        for mark in self._marks:
            mark.setValue(int(x[-1]))
        self._top.setXRange(0.5, max(2, x.size) + 0.5, padding=0)
        step = max(1, -(-x.size // 8))
        ticks = [(int(k), str(k)) for k in range(1, max(2, x.size) + 1, step)]
        for row in range(len(self._marks)):
            self._grid.getItem(row, 0).getAxis("bottom").setTicks([ticks])


class DriftPlot(QWidget):
    """Change of shift, rotation and scaling since the first look, with their errors."""

    def __init__(self, theme: Theme) -> None:
        super().__init__()
        self._theme = theme
        self._drift = RegistrationDrift.of(np.zeros((0, 11)))
        self._grid = pg.GraphicsLayoutWidget()
        layout = QVBoxLayout(self)
        layout.setContentsMargins(0, 0, 0, 0)
        layout.addWidget(self._grid)
        theme.changed.connect(self._build)
        self._build()

    def show_drift(self, drift: RegistrationDrift) -> None:
        """Show this course."""
        rebuilt = drift.marks != self._drift.marks or drift.unit != self._drift.unit
        self._drift = drift
        if rebuilt:
            self._build()
        else:
            self._fill()

    def _build(self) -> None:
        clear(self._grid)
        self._grid.setBackground(self._theme.colour("field"))
        self._bands: dict[int, ErrorBand] = {}
        for row, (title, unit, members) in enumerate(GROUPS):
            plot = add_plot(self._grid, row)
            last = row == len(GROUPS) - 1
            style_axis(
                self._theme, plot.getAxis("left"), f"Δ {title.lower()}", short_unit(unit), stacked=True
            )
            plot.getAxis("left").setWidth(self._theme.pixels(LEFT_AXIS_WIDTH))
            style_axis(self._theme, plot.getAxis("bottom"), *(("Time", self._drift.unit) if last else ("",)))
            plot.getAxis("bottom").setStyle(showValues=last)
            for member in members:
                self._bands[member] = ErrorBand(self._theme.series(member), width=1.0)
                self._bands[member].add_to(plot)
            for at, _ in self._drift.marks:
                plot.addItem(reference_line(self._theme, at, horizontal=False))
        self._fill()

    def _fill(self) -> None:
        change = self._drift.since_start()
        for member, band in self._bands.items():
            band.set(self._drift.time, change[:, member], self._drift.sigma[:, member])
