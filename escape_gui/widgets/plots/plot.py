"""Plots in the colours of the theme: live curves, strip charts, error bars, error bands."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pyqtgraph as pg
from numpy.typing import NDArray
from PySide6.QtCore import Qt
from PySide6.QtGui import QColor

from escape_gui.theme import Theme

#: Dashes by number of the curve, so that curves differ not only in colour.
DASHES = (
    Qt.PenStyle.SolidLine, Qt.PenStyle.DashLine, Qt.PenStyle.DotLine, Qt.PenStyle.DashDotLine,
    Qt.PenStyle.DashDotDotLine,
)  # fmt: skip
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

    def __init__(self, theme: Theme, name: str, x: str, y: str) -> None:
        super().__init__()
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
        theme.changed.connect(self.apply_theme)
        self.apply_theme()

    def curve(self, number: int, *, alone: bool = False, **options: Any) -> Any:
        """Add a curve in colour and dash ``number``, solid if ``alone``.

        The line width is 1, because wider lines take five times as long to draw.
        """
        item = pg.PlotDataItem(pen=self._pen(number, alone), **options)
        self.addItem(item)
        self._curves.append((item, number, alone))
        return item

    def pin_left_axis(self, characters: int = 6) -> None:
        """Fix the width of the left axis, so that plots above each other are aligned."""
        self.getAxis("left").setWidth(self._theme.pixels(9 * characters))

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


class TimeSeriesBuffer:
    """Times and values of the last ``size`` entries."""

    def __init__(self, size: int) -> None:
        self._times = np.full(2 * size, np.nan)
        self._values = np.full(2 * size, np.nan)
        self._size, self._end = size, 0

    def add(self, time: float, value: float) -> None:
        """Add an entry; times in seconds, increasing."""
        if self._end == self._times.size:
            for buffer in (self._times, self._values):
                buffer[: self._size] = buffer[self._size :]
            self._end = self._size
        self._times[self._end], self._values[self._end] = time, value
        self._end += 1

    def clear(self) -> None:
        self._end = 0

    @property
    def arrays(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Times and values ``(n,)``, oldest first; views that the next :meth:`add` may overwrite."""
        part = slice(max(self._end - self._size, 0), self._end)
        return self._times[part], self._values[part]


class StripChart(Plot):
    """A quantity over the last ``span_s`` seconds."""

    def __init__(self, theme: Theme, name: str, y: str, span_s: float = 120.0, number: int = 0) -> None:
        super().__init__(theme, name, "time before now [s]", y)
        self.span_s = span_s
        self._line = self.curve(number, alone=True, connect="finite")
        self.setXRange(-span_s, 0, padding=0.0)
        self.getPlotItem().enableAutoRange(axis="y")
        self.pin_left_axis()

    def show_history(self, history: TimeSeriesBuffer, now: float) -> None:
        times, values = history.arrays
        recent = times > now - self.span_s
        self._line.setData(times[recent] - now, values[recent])


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
        plot = self.addPlot(row=row, col=0, enableMenu=False)
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


@dataclass(slots=True, eq=False)
class ErrorCurve:
    """A line with markers, and error bars."""

    line: pg.PlotDataItem
    bars: pg.ErrorBarItem

    @classmethod
    def make(cls, theme: Theme, number: int, *, joined: bool = True, size: float = 6.0) -> ErrorCurve:
        """Create a curve in colour, marker and dash ``number``; without a line unless ``joined``."""
        colour = theme.series(number)
        pen = pg.mkPen(colour, width=1, style=DASHES[number % len(DASHES)]) if joined else None
        line = pg.PlotDataItem(
            pen=pen, symbol=MARKERS[number % len(MARKERS)][0], symbolSize=size, symbolBrush=colour,
            symbolPen=None, connect="finite",
        )  # fmt: skip
        zero = np.zeros(1)
        bars = pg.ErrorBarItem(x=zero, y=zero, height=zero, pen=pg.mkPen(colour, width=1))
        bars.setVisible(False)
        return cls(line, bars)

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
