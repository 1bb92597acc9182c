"""Plots in the theme's colours: axes, curves, error bars, error bands."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pyqtgraph as pg
from numpy.typing import NDArray
from PySide6.QtCore import Qt
from PySide6.QtGui import QColor

from escape_gui.theme import Theme


def reparent_menu(plot: pg.PlotItem) -> None:
    """Give a plot's menu, which nobody sees, to the widget that the plot stands in."""
    plot.setMenuEnabled(False)
    # Without its flags it would become a part of the widget, and be seen.
    plot.ctrlMenu.setParent(plot.getViewWidget(), plot.ctrlMenu.windowFlags())


#: Dashes that go with the colours of curves, so that colour is never the only difference.
DASHES = (
    Qt.PenStyle.SolidLine,
    Qt.PenStyle.DashLine,
    Qt.PenStyle.DotLine,
    Qt.PenStyle.DashDotLine,
    Qt.PenStyle.DashDotDotLine,
)


class Plot(pg.PlotWidget):  # type: ignore[misc]
    """Axes with a label and a unit each; no grid, for drawing one costs ten times as much as all curves.

    Parameters
    ----------
    name
        What it shows, for screen readers.
    x, y
        Labels with units.
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
            axis = self.getAxis(side)
            axis.enableAutoSIPrefix(False)
        theme.changed.connect(self.apply_theme)
        self.apply_theme()

    def curve(self, number: int, *, alone: bool = False, **options: Any) -> Any:
        """A new curve in colour and dash ``number``, solid when it is ``alone``.

        The pen's width is 1, for wider ones cost five times as much.
        """
        item = pg.PlotDataItem(pen=self._pen(number, alone), **options)
        self.addItem(item)
        self._curves.append((item, number, alone))
        return item

    def pin_left_axis(self, characters: int = 6) -> None:
        """Keep the left axis as wide as its numbers may become, so that plots above each other align."""
        self.getAxis("left").setWidth(self._theme.pixels(9 * characters))

    def hide_bottom_label(self) -> None:
        """The plot below says what the axis is."""
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
            axis = self.getAxis(side)
            axis.setLabel(label, color=colours.muted, **{"font-size": f"{small.pointSizeF():.1f}pt"})
        for item, number, alone in self._curves:
            item.setPen(self._pen(number, alone))


#: Markers and dashes by number of the curve, with the character that stands for each in words.
MARKERS = (("o", "●"), ("s", "■"), ("t1", "▲"), ("d", "◆"), ("t", "▼"), ("star", "★"))


def style_axis(
    theme: Theme,
    axis: pg.AxisItem,
    label: str,
    unit: str = "",
    colour: QColor | None = None,
    stacked: bool = False,
) -> None:
    """Give an axis its words and colours; the unit in brackets, ``stacked`` on a line of its own."""
    text = theme.colour("text") if colour is None else colour
    axis.setPen(theme.colour("line"))
    axis.setTextPen(text)
    axis.setTickFont(theme.font(0.85))
    axis.enableAutoSIPrefix(False)
    size = f"{theme.font(0.9).pointSizeF()}pt"
    words = f"{label}<br>[{unit}]" if unit and stacked else f"{label} [{unit}]" if unit else label
    axis.setLabel(words, color=text.name(), **{"font-size": size})


def add_plot(grid: pg.GraphicsLayoutWidget, row: int = 0) -> pg.PlotItem:
    """A plot in a row of a grid, without menus and hands."""
    plot = grid.addPlot(row=row, col=0, enableMenu=False)
    reparent_menu(plot)
    plot.hideButtons()
    plot.setMouseEnabled(x=False, y=False)
    plot.showGrid(x=True, y=True, alpha=0.18)
    return plot


def clear(grid: pg.GraphicsLayoutWidget) -> None:
    for item in tuple(grid.ci.items):
        if isinstance(item, pg.PlotItem):
            item.ctrlMenu.deleteLater()
    grid.clear()


@dataclass(slots=True, eq=False)
class ErrorCurve:
    """A line with markers and error bars, made once and filled again and again.

    Parameters
    ----------
    line
        Markers and the line between them.
    bars
        Error bars.
    """

    line: pg.PlotDataItem
    bars: pg.ErrorBarItem

    @classmethod
    def make(cls, theme: Theme, number: int, *, joined: bool = True, size: float = 6.0) -> ErrorCurve:
        """Curve ``number`` of a plot, in its colour, marker and dash."""
        colour = theme.series(number)
        pen = pg.mkPen(colour, width=1, style=DASHES[number % len(DASHES)]) if joined else None
        line = pg.PlotDataItem(
            pen=pen, symbol=MARKERS[number % len(MARKERS)][0], symbolSize=size, symbolBrush=colour,
            symbolPen=None, connect="finite",
        )  # fmt: skip
        bars = pg.ErrorBarItem(
            x=np.zeros(1), y=np.zeros(1), height=np.zeros(1), pen=pg.mkPen(colour, width=1)
        )
        bars.setVisible(False)
        return cls(line, bars)

    def add_to(self, box: Any) -> None:
        """Put it into a plot or a view box."""
        box.addItem(self.bars)
        box.addItem(self.line)

    def set(
        self, x: NDArray[Any], y: NDArray[np.float64], sigma: NDArray[np.float64] | None, cap: float = 0.0
    ) -> None:
        """Other points; errors that are not finite have no bar."""
        drawn = np.isfinite(y).any()
        self.line.setData(np.asarray(x, float) if drawn else np.zeros(0), y if drawn else np.zeros(0))
        known = np.isfinite(y) & np.isfinite(sigma) if sigma is not None else np.zeros(y.shape, bool)
        self.bars.setVisible(bool(known.any()))
        if sigma is not None and known.any():
            self.bars.setData(x=np.asarray(x, float)[known], y=y[known], height=2 * sigma[known], beam=cap)


class ErrorBand:
    """A line with a translucent band of one standard error.

    Parameters
    ----------
    colour
        Of line and band.
    width
        Of the line, in pixels.
    """

    def __init__(self, colour: QColor, width: float = 1.0) -> None:
        veil = QColor(colour)
        veil.setAlphaF(0.22)
        self.line = pg.PlotDataItem(pen=pg.mkPen(colour, width=width), connect="finite")
        self._low, self._high = pg.PlotCurveItem(pen=None), pg.PlotCurveItem(pen=None)
        self.fill = pg.FillBetweenItem(self._low, self._high, brush=veil)

    def add_to(self, box: Any) -> None:
        """Put it into a plot or a view box."""
        for item in (self.fill, self._low, self._high, self.line):
            box.addItem(item)

    def set(self, x: NDArray[Any], y: NDArray[np.float64], sigma: NDArray[np.float64]) -> None:
        """Another course; where its error is not known there is no band."""
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
    """A dashed reference line."""
    pen = pg.mkPen(colour or theme.colour("muted"), width=1, style=Qt.PenStyle.DashLine)
    return pg.InfiniteLine(value, angle=0 if horizontal else 90, pen=pen)
