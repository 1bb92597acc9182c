"""SPRINT's step norm and its parameters against the iteration."""

from __future__ import annotations

import numpy as np
import pyqtgraph as pg
from PySide6.QtWidgets import QVBoxLayout, QWidget

from escape_gui.theme import Theme
from escape_gui.views.convergence import GROUPS, NAMES, Course, short_unit
from escape_gui.widgets.curve_plot import ErrorCurve, add_plot, clear, line_at, style_axis

#: Width of the left axes at normal letter size, so that all plots begin at the same place.
AXIS = 66


class ConvergencePlot(QWidget):
    """Step norm above; below, all parameters on one axis, or each kind in its own unit.

    Parameters
    ----------
    theme
        Colours and fonts.
    """

    def __init__(self, theme: Theme) -> None:
        super().__init__()
        self._theme = theme
        self._course: Course | None = None
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

    def use_units(self, physical: bool) -> None:
        """Show parameters in their units, or all on one axis."""
        if physical != self._physical:
            self._physical = physical
            self._build()

    def show_course(self, course: Course | None) -> None:
        """Show this one; ``None``: nothing yet."""
        self._course = course
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
        self._marks = [line_at(self._theme, 1, horizontal=False)]
        top.addItem(self._marks[0])
        groups = GROUPS if self._physical else (("Normalised", "", tuple(range(len(NAMES)))),)
        for row, (title, unit, members) in enumerate(groups, 1):
            plot = self._plot(row, title, short_unit(unit), last=row == len(groups))
            plot.setXLink(top)
            for member in members:
                self._curves[member] = ErrorCurve.make(self._theme, member)
                self._curves[member].add_to(plot)
            mark = line_at(self._theme, 1, horizontal=False)
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
        plot.getAxis("left").setWidth(self._theme.pixels(AXIS))
        style_axis(self._theme, plot.getAxis("bottom"), "Iteration" if last else "")
        plot.getAxis("bottom").setStyle(showValues=last)
        return plot

    def _fill(self) -> None:
        course = self._course
        for mark in self._marks:
            mark.setVisible(course is not None and bool(course.converged))
        if course is None or not len(course.values):
            for curve in (self._norm, *self._curves.values()):
                curve.set(np.zeros(0), np.zeros(0), None)
            return
        drawn = course if self._physical else course.normalised()
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
