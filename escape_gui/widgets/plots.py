"""Plots in the colours of the theme: live curves, optical gains, convergence and drift."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import pyqtgraph as pg
from numpy.typing import NDArray
from PySide6.QtCore import Qt
from PySide6.QtGui import QColor, QFontMetricsF, QResizeEvent

from escape_gui.client.history import TimeSeriesBuffer
from escape_gui.theme import Theme
from escape_gui.views.convergence import GROUPS, NAMES, ConvergenceHistory, RegistrationDrift, short_unit
from escape_gui.views.gain_curves import GainCurve, axis_sides

#: Dashes by number of the curve, so that curves differ not only in colour.
DASHES = (
    Qt.PenStyle.SolidLine, Qt.PenStyle.DashLine, Qt.PenStyle.DotLine, Qt.PenStyle.DashDotLine,
    Qt.PenStyle.DashDotDotLine,
)  # fmt: skip
#: Room between two plots above each other.
_ROW_GAP_PX = 8
#: Vertical range of a chart without data.
_EMPTY_RANGE = (0.0, 100.0)
#: Markers by number of the curve: pyqtgraph's name, and the character for it in texts.
MARKERS = (("o", "●"), ("s", "■"), ("t1", "▲"), ("d", "◆"), ("t", "▼"), ("star", "★"))


def reparent_menu(plot: pg.PlotItem) -> None:
    """Make the (disabled) menu of a plot a child of the widget, so that it is deleted with the widget."""
    plot.setMenuEnabled(False)
    # The flags keep it a separate, hidden window.
    plot.ctrlMenu.setParent(plot.getViewWidget(), plot.ctrlMenu.windowFlags())


class Plot(pg.PlotWidget):  # type: ignore[misc]
    """A plot for live curves; ``x`` and ``y`` are the labels of the axes, with units.

    It has no grid, which takes ten times as long to draw as the curves.
    """

    def __init__(self, theme: Theme, name: str, x: str, y: str, left: pg.AxisItem | None = None) -> None:
        """``left``: another axis than the usual one."""
        super().__init__(axisItems={"bottom": SparseAxis("bottom"), "left": left or pg.AxisItem("left")})
        self._theme, self._labels = theme, {"bottom": x, "left": y}
        self._curves: list[tuple[Any, int, bool]] = []
        self.setAccessibleName(name)
        reparent_menu(self.getPlotItem())
        self.hideButtons()
        self.setMouseEnabled(x=False, y=False)
        self.setFocusPolicy(Qt.FocusPolicy.NoFocus)
        self.setMinimumSize(120, 64)
        for side in ("left", "bottom"):
            self.getAxis(side).enableAutoSIPrefix(False)
        theme.follow(self.apply_theme)

    def curve(self, number: int, *, alone: bool = False, **options: Any) -> Any:
        """Add a curve in colour and dash ``number``, solid if ``alone``.

        The line width is 1, because wider lines take five times as long to draw.
        """
        item = pg.PlotDataItem(pen=self._pen(number, alone), **options)
        self.addItem(item)
        self._curves.append((item, number, alone))
        return item

    def pin_left_axis(self) -> None:
        """Fix the left axis to the width of six characters, so that plots above each other are aligned."""
        self.getAxis("left").setWidth(self._theme.pixels(54))

    def hide_bottom_label(self) -> None:
        del self._labels["bottom"]
        self.getAxis("bottom").showLabel(False)

    def _pen(self, number: int, alone: bool) -> Any:
        dash = DASHES[0] if alone else DASHES[number % len(DASHES)]
        return pg.mkPen(self._theme.series(number), width=1, style=dash)

    def apply_theme(self) -> None:
        colours = self._theme.colours
        self.setBackground(colours.field)
        small = self._theme.font(0.85)
        for side in ("bottom", "left"):
            axis = self.getAxis(side)
            axis.setPen(colours.line)
            axis.setTextPen(colours.muted)
            axis.setTickFont(small)
        for side, label in self._labels.items():
            size = f"{small.pointSizeF():.1f}pt"
            self.getAxis(side).setLabel(label, color=colours.muted, **{"font-size": size})
        for item, number, alone in self._curves:
            item.setPen(self._pen(number, alone))


class SectionPlot(Plot):
    """Row and column of an image through a pixel, by default the brightest."""

    def __init__(self, theme: Theme, unit: str) -> None:
        super().__init__(theme, "Cross-section of the image", "pixel", unit)
        self._row, self._column = self.curve(0, name="row"), self.curve(1, name="column")
        #: Column and row of the pixel; ``None``: the brightest.
        self.place: tuple[int, int] | None = None

    def show_image(self, image: NDArray[Any]) -> tuple[int, int]:
        """Show the sections of an image ``(rows, columns)``; returns the pixel they go through."""
        x, y = self.place or (0, 0)
        if self.place is None or not (x < image.shape[1] and y < image.shape[0]):
            row, column = np.unravel_index(int(np.nanargmax(image)), image.shape)
            x, y = int(column), int(row)
        self._row.setData(np.arange(image.shape[1]), image[y])
        self._column.setData(np.arange(image.shape[0]), image[:, x])
        return x, y


class StripChart(Plot):
    """A quantity over the last ``span_s`` seconds."""

    def __init__(self, theme: Theme, name: str, y: str, number: int = 0) -> None:
        self._title = y
        super().__init__(theme, name, "time before now [s]", y)
        self._line = self.curve(number, alone=True, connect="finite")
        # Room for the upper half of the highest tick label.
        self.getPlotItem().layout.setContentsMargins(1, 8, 1, 1)
        # Hours are more points than pixels.
        self._line.setDownsampling(auto=True, method="peak")
        self.setYRange(*_EMPTY_RANGE)
        self.pin_left_axis()
        self.set_span(120.0)
        self.getPlotItem().getViewBox().sigResized.connect(lambda _: self._fit_title())

    def _fit_title(self) -> None:
        """A low chart has only the unit, ``[...]`` at the end of the title, along its axis."""
        axis, metrics = self.getAxis("left"), QFontMetricsF(self._theme.font(0.85))
        fits = metrics.horizontalAdvance(self._title) <= axis.size().height() + _ROW_GAP_PX
        label = self._title if fits else self._title[self._title.index("[") :]
        if label != self._labels["left"]:
            self._labels["left"] = label
            axis.setLabel(label)
            axis.resizeEvent()

    def set_span(self, span_s: float) -> None:
        """Show the last ``span_s`` seconds, in seconds, minutes or hours."""
        self.span_s = span_s
        self._unit_s, unit = (1, "s") if span_s <= 120 else (60, "min") if span_s < 7200 else (3600, "h")
        self.getPlotItem().setLabel("bottom", f"time before now [{unit}]")
        self.setXRange(-span_s / self._unit_s, 0, padding=0.0)

    def show_history(self, history: TimeSeriesBuffer, now: float) -> None:
        times, values = history.arrays
        first = int(np.searchsorted(times, now - self.span_s))
        if np.isfinite(values[first:]).any():
            self.getPlotItem().enableAutoRange(axis="y")
        else:
            self.setYRange(*_EMPTY_RANGE)
        self._line.setData((times[first:] - now) / self._unit_s, values[first:])


class SparseAxis(pg.AxisItem):  # type: ignore[misc]
    """An axis without more numbers than there is room for."""

    def tickValues(self, low: float, high: float, size: float) -> list[tuple[float, list[float]]]:
        levels: list[tuple[float, list[float]]] = super().tickValues(low, high, size)
        if not levels:
            return levels
        (spacing, values), *others = levels
        metrics = QFontMetricsF(self.style["tickFont"] or self.font())
        if self.orientation in ("left", "right"):
            room = metrics.height()
        else:
            texts = self.tickStrings(values, self.autoSIPrefixScale * self.scale, spacing)
            room = max(map(metrics.horizontalAdvance, (*texts, ""))) + metrics.averageCharWidth()
        gap = size * (values[1] - values[0]) / (high - low) if len(values) > 1 and high > low else room
        step = max(1, math.ceil(room / gap))
        return [(spacing, list(values[::step])), *(others if step == 1 else ())]


class PlotGrid(pg.GraphicsLayoutWidget):  # type: ignore[misc]
    """Plots above each other, with grid lines, rebuilt by the subclass in :meth:`build`."""

    def __init__(self, theme: Theme) -> None:
        super().__init__()
        self._theme = theme
        theme.changed.connect(self.build)

    def build(self) -> None:
        """Remove all plots. A subclass extends this method to add its plots, in the colours of the theme."""
        for item in tuple(self.ci.items):
            if isinstance(item, pg.PlotItem):
                item.ctrlMenu.deleteLater()
        self.clear()
        self.setBackground(self._theme.colour("field"))

    def add_plot(self, row: int = 0) -> pg.PlotItem:
        """Add a plot without menu and mouse interaction."""
        plot = self.addPlot(row=row, col=0, enableMenu=False, axisItems={"left": SparseAxis("left")})
        reparent_menu(plot)
        plot.hideButtons()
        plot.setMouseEnabled(x=False, y=False)
        plot.showGrid(x=True, y=True, alpha=0.18)
        return plot


def style_axis(theme: Theme, axis: pg.AxisItem, label: str, colour: QColor | None = None) -> None:
    """Set label and colours of an axis."""
    text = theme.colour("text") if colour is None else colour
    axis.setPen(theme.colour("line"))
    axis.setTextPen(text)
    axis.setTickFont(theme.font(0.85))
    axis.enableAutoSIPrefix(False)
    axis.setLabel(label, color=text.name(), **{"font-size": f"{theme.font(0.9).pointSizeF()}pt"})


class ErrorCurve:
    """Error bars and markers in colour, marker and dash ``number``; with a line if ``joined``."""

    def __init__(self, theme: Theme, number: int, *, joined: bool = True, size: float = 6.0) -> None:
        colour = theme.series(number)
        pen = pg.mkPen(colour, width=1, style=DASHES[number % len(DASHES)]) if joined else None
        self.line = pg.PlotDataItem(
            pen=pen, symbol=MARKERS[number % len(MARKERS)][0], symbolSize=size, symbolBrush=colour,
            symbolPen=None, connect="finite",
        )  # fmt: skip
        zero = np.zeros(1)
        self.bars = pg.ErrorBarItem(x=zero, y=zero, height=zero, pen=pg.mkPen(colour, width=1))
        self.bars.setVisible(False)

    def add_to(self, box: Any) -> None:
        box.addItem(self.bars)
        box.addItem(self.line)

    def set(
        self, x: NDArray[Any], y: NDArray[np.float64], sigma: NDArray[np.float64] | None, cap: float = 0.0
    ) -> None:
        """Set points ``(n,)`` and standard errors; errors that are not finite have no bar."""
        drawn = np.isfinite(y).any()
        self.line.setData(np.asarray(x, float) if drawn else np.zeros(0), y if drawn else np.zeros(0))
        known = np.isfinite(y) & np.isfinite(sigma) if sigma is not None else np.zeros(y.shape, bool)
        self.bars.setVisible(bool(known.any()))
        if sigma is not None and known.any():
            self.bars.setData(x=np.asarray(x, float)[known], y=y[known], height=2 * sigma[known], beam=cap)


class ErrorBand:
    """A line with a translucent band of one standard error."""

    def __init__(self, colour: QColor, width: float = 1.0) -> None:
        translucent = QColor(colour)
        translucent.setAlphaF(0.22)
        self.line = pg.PlotDataItem(pen=pg.mkPen(colour, width=width), connect="finite")
        self._low, self._high = pg.PlotCurveItem(pen=None), pg.PlotCurveItem(pen=None)
        self.fill = pg.FillBetweenItem(self._low, self._high, brush=translucent)

    def add_to(self, box: Any) -> None:
        for item in (self.fill, self._low, self._high, self.line):
            box.addItem(item)

    def set(self, x: NDArray[Any], y: NDArray[np.float64], sigma: NDArray[np.float64]) -> None:
        """Set points ``(n,)`` and standard errors; errors that are not finite have no band."""
        x = np.asarray(x, float)
        self.line.setData(x, y)
        known = np.isfinite(y) & np.isfinite(sigma)
        self.fill.setVisible(bool(known.sum() > 1))
        if known.sum() > 1:
            self._low.setData(x[known], (y - sigma)[known])
            self._high.setData(x[known], (y + sigma)[known])


def reference_line(
    theme: Theme, value: float, *, horizontal: bool, colour: QColor | None = None
) -> pg.InfiniteLine:
    """A dashed straight line."""
    pen = pg.mkPen(colour or theme.colour("muted"), width=1, style=Qt.PenStyle.DashLine)
    return pg.InfiniteLine(value, angle=0 if horizontal else 90, pen=pen)


#: Opacity of the earlier rounds of the bootstrap.
_EARLIER_ROUNDS_ALPHA = 0.45


class GainsPlot(PlotGrid):
    """Measured gains with error bars, their trend, and a line at 1 on each axis."""

    def __init__(self, theme: Theme) -> None:
        super().__init__(theme)
        self._curves: dict[str, GainCurve] = {}
        self._show_rounds = True
        self.build()

    @property
    def labels(self) -> dict[str, str]:
        """Axis of each curve by its label, ``left`` or ``right``."""
        return axis_sides(self._curves)

    def show_rounds(self, on: bool) -> None:
        if on != self._show_rounds:
            self._show_rounds = on
            self.build()

    def show_curves(self, curves: Mapping[str, GainCurve]) -> None:
        self._curves = dict(curves)
        if self._item_layout() != self._built:
            self.build()
        else:
            self._fill()

    def _item_layout(self) -> object:
        """Everything that determines the items of the plot, except their data."""
        rounds = {label: len(curve.rounds) for label, curve in self._curves.items()}
        return axis_sides(self._curves), rounds if self._show_rounds else None

    def build(self) -> None:
        super().build()
        self._built = self._item_layout()
        self._plot = self.add_plot()
        sides = axis_sides(self._curves)
        style_axis(self._theme, self._plot.getAxis("bottom"), "Mode")
        self._boxes: dict[str, pg.ViewBox] = {"left": self._plot.getViewBox()}
        self._style_side(sides, "left")
        if "right" in sides.values():
            self._boxes["right"] = self._add_right_axis()
            self._style_side(sides, "right")
        self._items = {
            label: self._add_items(self._plot if sides[label] == "left" else self._boxes["right"], k, curve)
            for k, (label, curve) in enumerate(self._curves.items())
        }
        self._fill()

    def _style_side(self, sides: Mapping[str, str], side: str) -> None:
        """Label an axis and draw its line at 1; an axis with a single curve has the colour of the curve."""
        numbers = [number for number, label in enumerate(sides) if sides[label] == side]
        colour = self._theme.series(numbers[0]) if len(numbers) == 1 and len(sides) > 1 else None
        label = f"Optical gain, {side}" if len(set(sides.values())) > 1 else "Optical gain"
        style_axis(self._theme, self._plot.getAxis(side), label, colour)
        line = reference_line(self._theme, 1.0, horizontal=True, colour=colour)
        (self._plot if side == "left" else self._boxes[side]).addItem(line)

    def _add_right_axis(self) -> pg.ViewBox:
        """Add a view box over the plot, with the same bottom axis."""
        box = pg.ViewBox(enableMenu=False)
        box.setMouseEnabled(x=False, y=False)
        self._plot.showAxis("right")
        self._plot.scene().addItem(box)
        axis = self._plot.getAxis("right")
        axis.linkToView(box)
        axis.setGrid(False)
        box.setXLink(self._plot)
        main = self._plot.getViewBox()
        main.sigResized.connect(lambda: box.setGeometry(main.sceneBoundingRect()))
        box.setGeometry(main.sceneBoundingRect())
        return box

    def _add_items(
        self, box: pg.PlotItem | pg.ViewBox, number: int, curve: GainCurve
    ) -> tuple[list[pg.PlotCurveItem], ErrorCurve, ErrorBand]:
        colour = self._theme.series(number)
        faint = QColor(colour)
        faint.setAlphaF(_EARLIER_ROUNDS_ALPHA)
        n_earlier = max(0, len(curve.rounds) - 1) if self._show_rounds else 0
        rounds = [pg.PlotCurveItem(pen=pg.mkPen(faint, width=1), connect="finite") for _ in range(n_earlier)]
        for one in rounds:
            box.addItem(one)
        points = ErrorCurve(self._theme, number, joined=False, size=5.0)
        points.add_to(box)
        trend = ErrorBand(colour, width=2.0)
        trend.add_to(box)
        return rounds, points, trend

    def _fill(self) -> None:
        for label, (rounds, points, trend) in self._items.items():
            curve = self._curves[label]
            for item, earlier in zip(rounds, curve.rounds, strict=False):
                item.setData(curve.modes, earlier)
            points.set(curve.modes, curve.value, curve.sigma)
            trend.set(curve.modes, curve.trend, curve.trend_sigma)
        count = max((curve.value.size for curve in self._curves.values()), default=1)
        self._plot.setXRange(0.5, count + 0.5, padding=0.01)
        sides = axis_sides(self._curves)
        for side, box in self._boxes.items():
            curves = [one for label, one in self._curves.items() if sides[label] == side]
            if curves:
                box.setYRange(*_y_range(curves), padding=0.04)


def _y_range(curves: list[GainCurve]) -> tuple[float, float]:
    """Range of all gains without outliers (percentiles 0.5 and 99.5), extended to include 1."""
    gains = np.concatenate([one.trend for one in curves] + [one.value for one in curves] + [np.ones(1)])
    low, high = np.percentile(gains[np.isfinite(gains)], (0.5, 99.5))
    return float(min(low, 1.0)), float(max(high, 1.0))


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
        plot.getViewBox().sigResized.connect(lambda _, axis=left: _fit_title(axis))
        return plot


def _fit_title(axis: pg.AxisItem) -> None:
    """Hide the title of an axis that is longer than the axis; it would overlap the next one."""
    axis.showLabel(axis.label.boundingRect().width() <= axis.size().height() + _ROW_GAP_PX)


#: Least height of plots below each other with a title below the last one.
_LEAST_TITLED_PX = 180


class ConvergencePlot(_ParameterGrid):
    """Step norm; below, all parameters normalised on one axis, or each group in its physical unit."""

    def __init__(self, theme: Theme) -> None:
        # It gets events before it has plots.
        self._plots: list[pg.PlotItem] = []
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
        # In a low plot the labels between two decades overlap.
        top.getAxis("left").setStyle(maxTextLevel=0)
        self._norm = ErrorCurve(self._theme, 0)
        self._norm.add_to(top)
        groups = GROUPS if self.physical else (("Normalised", "", tuple(range(len(NAMES)))),)
        plots = [top]
        for row, (title, unit, members) in enumerate(groups, 1):
            plot = self._add_row(row, title, unit, "Iteration" if row == len(groups) else "")
            plot.setXLink(top)
            for member in members:
                self._curves[member] = ErrorCurve(self._theme, member)
                self._curves[member].add_to(plot)
            plots.append(plot)
        self._marks = [reference_line(self._theme, 1, horizontal=False) for _ in plots]
        for row, (plot, mark) in enumerate(zip(plots, self._marks, strict=True)):
            plot.addItem(mark)
            self.ci.layout.setRowStretchFactor(row, 3 if row or self.physical else 2)
        self._plots = plots
        self._fit_label()
        self._fill()

    def resizeEvent(self, event: QResizeEvent | None) -> None:
        super().resizeEvent(event)
        self._fit_label()

    def _fit_label(self) -> None:
        """Low plots have no title below, which would take half of their height."""
        for plot in self._plots[-1:]:
            plot.getAxis("bottom").showLabel(self.height() >= self._theme.pixels(_LEAST_TITLED_PX))

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
