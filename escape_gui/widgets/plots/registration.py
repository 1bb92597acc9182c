"""Convergence of SPRINT by iteration, and drift of the registration over time."""

from __future__ import annotations

import numpy as np
import pyqtgraph as pg

from escape_gui.theme import Theme
from escape_gui.views.convergence import GROUPS, NAMES, ConvergenceHistory, RegistrationDrift, short_unit
from escape_gui.widgets.plots.plot import ErrorBand, ErrorCurve, PlotGrid, reference_line, style_axis

#: Width of the left axes at font scale 1, the same for all plots, pixels.
LEFT_AXIS_WIDTH = 66


class _ParameterGrid(PlotGrid):
    """Plots with a common bottom axis."""

    def _add_row(self, row: int, title: str, unit: str, bottom: str) -> pg.PlotItem:
        """Add a plot; its bottom axis is labelled only if ``bottom`` is given."""
        plot = self.add_plot(row)
        left = plot.getAxis("left")
        style_axis(self._theme, left, f"{title}<br>[{short_unit(unit)}]" if unit else title)
        left.setWidth(self._theme.pixels(LEFT_AXIS_WIDTH))
        style_axis(self._theme, plot.getAxis("bottom"), bottom)
        plot.getAxis("bottom").setStyle(showValues=bool(bottom))
        return plot


class ConvergencePlot(_ParameterGrid):
    """Step norm; below, all parameters normalised on one axis, or each group in its physical unit."""

    def __init__(self, theme: Theme) -> None:
        super().__init__(theme)
        self._history: ConvergenceHistory | None = None
        #: Parameters are shown in their physical units; otherwise normalised.
        self.physical = False
        self.build()

    def set_physical_units(self, physical: bool) -> None:
        if physical != self.physical:
            self.physical = physical
            self.build()

    def show_convergence(self, history: ConvergenceHistory | None) -> None:
        """Show a fit; ``None``: empty plots."""
        self._history = history
        self._fill()

    def build(self) -> None:
        super().build()
        self._curves: dict[int, ErrorCurve] = {}
        top = self._add_row(0, "Step norm", "", "")
        top.setLogMode(y=True)
        self._norm = ErrorCurve.make(self._theme, 0)
        self._norm.add_to(top)
        groups = GROUPS if self.physical else (("Normalised", "", tuple(range(len(NAMES)))),)
        plots = [top]
        for row, (title, unit, members) in enumerate(groups, 1):
            plot = self._add_row(row, title, unit, "Iteration" if row == len(groups) else "")
            plot.setXLink(top)
            for member in members:
                self._curves[member] = ErrorCurve.make(self._theme, member)
                self._curves[member].add_to(plot)
            plots.append(plot)
        self._marks = [reference_line(self._theme, 1, horizontal=False) for _ in plots]
        for row, (plot, mark) in enumerate(zip(plots, self._marks, strict=True)):
            plot.addItem(mark)
            self.ci.layout.setRowStretchFactor(row, 3 if row or self.physical else 2)
        self._plots = plots
        self._fill()

    def _fill(self) -> None:
        history = self._history
        for mark in self._marks:
            mark.setVisible(history is not None and bool(history.converged))
        if history is None or not len(history.values):
            for curve in (self._norm, *self._curves.values()):
                curve.set(np.zeros(0), np.zeros(0), None)
            return
        shown = history if self.physical else history.normalise()
        x = shown.iterations
        self._norm.set(x, shown.step_norm, None)
        for member, curve in self._curves.items():
            errors = np.full(x.size, np.nan)
            errors[-1] = shown.sigma[member]
            curve.set(x, shown.values[:, member], errors, cap=0.2)
        for mark in self._marks:
            mark.setValue(int(x[-1]))
        last = max(2, x.size)
        self._plots[0].setXRange(0.5, last + 0.5, padding=0)
        ticks = [(int(k), str(k)) for k in range(1, last + 1, max(1, -(-x.size // 8)))]
        for plot in self._plots:
            plot.getAxis("bottom").setTicks([ticks])


class DriftPlot(_ParameterGrid):
    """Change of the parameters since the start of tracking, with bands of one standard error."""

    def __init__(self, theme: Theme) -> None:
        super().__init__(theme)
        self._drift = RegistrationDrift.of(np.zeros((0, 11)))
        self.build()

    def show_drift(self, drift: RegistrationDrift) -> None:
        rebuild = drift.marks != self._drift.marks or drift.unit != self._drift.unit
        self._drift = drift
        if rebuild:
            self.build()
        else:
            self._fill()

    def build(self) -> None:
        super().build()
        self._bands: dict[int, ErrorBand] = {}
        for row, (title, unit, members) in enumerate(GROUPS):
            bottom = f"Time [{self._drift.unit}]" if row == len(GROUPS) - 1 else ""
            plot = self._add_row(row, f"Δ {title.lower()}", unit, bottom)
            for member in members:
                self._bands[member] = ErrorBand(self._theme.series(member))
                self._bands[member].add_to(plot)
            for time, _ in self._drift.marks:
                plot.addItem(reference_line(self._theme, time, horizontal=False))
        self._fill()

    def _fill(self) -> None:
        change = self._drift.since_start()
        for member, band in self._bands.items():
            band.set(self._drift.time, change[:, member], self._drift.sigma[:, member])
