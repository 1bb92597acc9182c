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
_LEFT_AXIS_WIDTH = 46
#: Labelled frequencies.
_FREQUENCIES_HZ = tuple(k * 10.0**n for n in range(-3, 5) for k in (1, 2, 5))
#: Characters for solid and dashed lines in texts.
_LINES = ("—", "- -")
_MODE_CURVES = ("residual", "without correction")


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
        self._labels: dict[int, pg.LabelItem] = {}
        self._axes: list[pg.AxisItem] = []
        self.add_curves()
        for name, (x, y) in self._data.items():
            self.curves[name].setData(x, y)
        self._show_tick_labels()

    def _show_tick_labels(self) -> None:
        """Numbers at the axes, which mean nothing without data."""
        has_data = any(np.isfinite(y).any() for _, y in self._data.values())
        for axis in self._axes:
            axis.setStyle(showValues=has_data)

    def add_curves(self) -> None:
        """Add the plots and their curves; for the subclass."""

    def _add_axes(self, number: int, bottom: str, *, log: tuple[bool, bool] = (False, False)) -> Any:
        """Add a plot below a line of text, see :meth:`_set_label`, because labels along low axes overlap."""
        self._labels[number] = self.addLabel("", row=2 * number, col=0, justify="left")
        plot = self.add_plot(2 * number + 1)
        self._axes += [plot.getAxis("left"), *([plot.getAxis("bottom")] if bottom else ())]
        plot.setLogMode(*log)
        style_axis(self._theme, plot.getAxis("left"), "")
        plot.getAxis("left").showLabel(False)
        plot.getAxis("left").setWidth(self._theme.pixels(_LEFT_AXIS_WIDTH))
        style_axis(self._theme, plot.getAxis("bottom"), bottom)
        for side, is_log in zip(("bottom", "left"), log, strict=True):
            if is_log:
                # Labels between two decades overlap.
                plot.getAxis(side).setStyle(maxTextLevel=0)
        return plot

    def _set_label(self, number: int, title: str, *names: str) -> None:
        """Show a title and names of the curves, in their order and colours."""
        keys = (
            f"<span style='color:{self._theme.series(k).name()}'>{_LINES[k]} {name}</span>"
            for k, name in enumerate(names)
        )
        size = f"{self._theme.font(0.85).pointSizeF()}pt"
        colour = self._theme.colour("text")
        self._labels[number].setText("&nbsp;&nbsp; ".join((title, *keys)), size=size, color=colour)

    def _add(self, plot: Any, name: str, number: int) -> None:
        pen = pg.mkPen(self._theme.series(number), width=1, style=DASHES[number % len(DASHES)])
        self.curves[name] = pg.PlotDataItem(pen=pen, connect="finite")
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
        self._show_tick_labels()


class ResidualPlot(_CurveGrid):
    """Rms of every mode, residual and without correction."""

    def __init__(self, theme: Theme) -> None:
        super().__init__(theme, "Residual by mode")

    def add_curves(self) -> None:
        plot = self._add_axes(0, "Mode", log=(False, True))
        self._set_label(0, "nm rms wavefront:", *_MODE_CURVES)
        self._add(plot, "open", 1)
        self._add(plot, "residual", 0)

    def show_modes(self, residual: NDArray[np.float64], open_loop: NDArray[np.float64]) -> None:
        """Show rms wavefronts ``(n_modes,)`` in nm; ``open_loop`` may be empty."""
        numbers = np.arange(1, residual.size + 1)
        self._show("open", numbers, open_loop)
        self._show("residual", numbers, residual)


class SpectraPlot(_CurveGrid):
    """Spectra of modes or slopes above the rejection of the loop."""

    def __init__(self, theme: Theme) -> None:
        self._title = ""
        super().__init__(theme, "Power spectra and rejection")

    def add_curves(self) -> None:
        top = self._add_axes(0, "", log=(True, True))
        self._add(top, "open", 1)
        self._add(top, "residual", 0)
        bottom = self._add_axes(1, "Frequency [Hz]", log=(True, False))
        self._set_label(0, self._title, *_MODE_CURVES)
        self._set_label(1, "Rejection [dB]:", "ratio of both", "integrator")
        self._add(bottom, "measured", 0)
        self._add(bottom, "model", 1)
        zero = pg.InfiniteLine(0.0, angle=0, pen=pg.mkPen(self._theme.colour("muted"), width=1))
        bottom.addItem(zero, ignoreBounds=True)
        bottom.setXLink(top)
        for plot in (top, bottom):
            plot.getAxis("bottom").setTicks([[(float(np.log10(f)), f"{f:g}") for f in _FREQUENCIES_HZ]])
        top.getAxis("bottom").setStyle(showValues=False)
        top.getAxis("bottom").showLabel(False)
        self.ci.layout.setRowStretchFactor(1, 3)
        self.ci.layout.setRowStretchFactor(3, 2)

    def show_spectra(self, spectra: Spectra) -> None:
        """Show spectra and rejection."""
        self._title = f"{spectra.unit}:"
        self._set_label(0, self._title, *_MODE_CURVES)
        x, closed = spectra.frequency_hz, bool(spectra.residual.any())
        none = np.zeros(0)
        self._show("residual", x, spectra.residual)
        self._show("open", x, spectra.open_loop if spectra.open_loop.any() else none)
        self._show("measured", x, spectra.measured_db if spectra.open_loop.any() else none)
        self._show("model", x, spectra.rejection_db if closed else none)


class GainByModePlot(_CurveGrid):
    """Gain in use and the optimal one, by mode."""

    def __init__(self, theme: Theme) -> None:
        self._title = ""
        super().__init__(theme, "Gain by mode")

    def add_curves(self) -> None:
        self._plot = self._add_axes(0, "Mode")
        self._set_label(0, self._title, "smallest residual", "in use")
        self._add(self._plot, "optimal", 0)
        self._add(self._plot, "used", 1)

    def show_gains(self, gain: float, optimal: NDArray[np.float64], largest: float) -> None:
        """Show the gain in use and the optimal ones ``(n_modes,)``, at most ``largest``."""
        self._title = f"Gain (at most {largest:.2g}):"
        self._set_label(0, self._title, "smallest residual", "in use")
        numbers = np.arange(1, optimal.size + 1)
        self._show("optimal", numbers, optimal)
        self._show("used", numbers, np.full(optimal.size, gain))
        self._plot.setYRange(0, max(gain, largest) * 1.1)
