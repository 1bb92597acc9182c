"""Plots of analysed telemetry: residual and gain by mode, spectra and rejection."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyqtgraph as pg
from numpy.typing import NDArray

from escape_gui.theme import Theme
from escape_gui.views.telemetry import Spectra
from escape_gui.widgets.plots import DASHES, PlotGrid, style_axis

#: Decades below the largest value that a logarithmic axis shows at most.
_DECADES = 7
_LEFT_AXIS_WIDTH = 62


class _CurveGrid(PlotGrid):
    """Plots with named curves, whose data survive a change of the theme."""

    def __init__(self, theme: Theme, name: str) -> None:
        super().__init__(theme)
        self.setAccessibleName(name)
        self._data: dict[str, tuple[NDArray[Any], NDArray[Any]]] = {}
        self.build()

    def build(self) -> None:
        super().build()
        self.curves: dict[str, pg.PlotDataItem] = {}
        self.add_curves()
        for name, (x, y) in self._data.items():
            self.curves[name].setData(x, y)

    def add_curves(self) -> None:
        """Add the plots and their curves; for the subclass."""

    def _add_axes(self, row: int, left: str, bottom: str, *, log: tuple[bool, bool] = (False, False)) -> Any:
        plot = self.add_plot(row)
        plot.setLogMode(*log)
        style_axis(self._theme, plot.getAxis("left"), left)
        plot.getAxis("left").setWidth(self._theme.pixels(_LEFT_AXIS_WIDTH))
        style_axis(self._theme, plot.getAxis("bottom"), bottom)
        legend = plot.addLegend(offset=(-8, 4), labelTextSize=f"{self._theme.font(0.85).pointSizeF()}pt")
        legend.setLabelTextColor(self._theme.colour("text"))
        return plot

    def _add(self, plot: Any, name: str, label: str, number: int, **options: Any) -> None:
        pen = pg.mkPen(self._theme.series(number), width=1, style=DASHES[number % len(DASHES)])
        self.curves[name] = pg.PlotDataItem(pen=pen, name=label, connect="finite", **options)
        plot.addItem(self.curves[name])

    def _show(self, name: str, x: NDArray[Any], y: NDArray[Any]) -> None:
        values = np.asarray(y, float)
        if self.curves[name].opts["logMode"][1]:
            # Zeros have no logarithm, and noise-free simulations reach arbitrarily small densities.
            positive = values[values > 0]
            floor = positive.max() / 10**_DECADES if positive.size else 1.0
            values = np.where(values > floor, values, np.nan)
        self._data[name] = (x[: values.size], values)
        self.curves[name].setData(*self._data[name])


class ResidualPlot(_CurveGrid):
    """Rms of every mode, residual and without correction."""

    def __init__(self, theme: Theme) -> None:
        super().__init__(theme, "Residual by mode")

    def add_curves(self) -> None:
        plot = self._add_axes(0, "nm rms wavefront", "Mode", log=(False, True))
        self._add(plot, "open", "without correction", 1)
        self._add(plot, "residual", "residual", 0)

    def show_modes(self, residual: NDArray[np.float64], open_loop: NDArray[np.float64]) -> None:
        """Show rms wavefronts ``(n_modes,)`` in nm; ``open_loop`` may be empty."""
        numbers = np.arange(1, residual.size + 1)
        self._show("open", numbers, open_loop)
        self._show("residual", numbers, residual)


class SpectraPlot(_CurveGrid):
    """Spectra of modes or slopes above the rejection of the loop."""

    def __init__(self, theme: Theme) -> None:
        self._unit = "nm² / Hz"
        super().__init__(theme, "Power spectra and rejection")

    def add_curves(self) -> None:
        self._top = self._add_axes(0, self._unit, "", log=(True, True))
        self._add(self._top, "open", "without correction", 1)
        self._add(self._top, "residual", "residual", 0)
        self._bottom = self._add_axes(1, "rejection [dB]", "Frequency [Hz]", log=(True, False))
        self._add(self._bottom, "measured", "residual / without correction", 0)
        self._add(self._bottom, "model", "integrator", 1)
        zero = pg.InfiniteLine(0.0, angle=0, pen=pg.mkPen(self._theme.colour("muted"), width=1))
        self._bottom.addItem(zero, ignoreBounds=True)
        self._bottom.setXLink(self._top)
        self._top.getAxis("bottom").setStyle(showValues=False)
        self._top.getAxis("bottom").showLabel(False)
        self.ci.layout.setRowStretchFactor(0, 3)
        self.ci.layout.setRowStretchFactor(1, 2)

    def show_spectra(self, spectra: Spectra) -> None:
        """Show spectra and rejection."""
        if spectra.unit != self._unit:
            self._unit = spectra.unit
            style_axis(self._theme, self._top.getAxis("left"), self._unit)
        x, closed = spectra.frequency_hz, bool(spectra.residual.any())
        none = np.zeros(0)
        self._show("residual", x, spectra.residual)
        self._show("open", x, spectra.open_loop if spectra.open_loop.any() else none)
        self._show("measured", x, spectra.measured_db if spectra.open_loop.any() else none)
        self._show("model", x, spectra.rejection_db if closed else none)


class GainByModePlot(_CurveGrid):
    """Gain in use and the optimal one, by mode."""

    def __init__(self, theme: Theme) -> None:
        super().__init__(theme, "Gain by mode")

    def add_curves(self) -> None:
        plot = self._add_axes(0, "Gain", "Mode")
        self._add(plot, "optimal", "smallest residual", 0)
        self._add(plot, "used", "in use", 1)
        self._plot = plot

    def show_gains(self, gain: float, optimal: NDArray[np.float64]) -> None:
        """Show the gain in use, and the optimal ones ``(n_modes,)``."""
        numbers = np.arange(1, optimal.size + 1)
        self._show("optimal", numbers, optimal)
        self._show("used", numbers, np.full(optimal.size, gain))
        self._plot.setYRange(0, max(gain, float(optimal.max(initial=0.0)), 0.1) * 1.15)
