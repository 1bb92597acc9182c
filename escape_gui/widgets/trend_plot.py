"""Plots of trends above each other, against the time of day or by night."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pyqtgraph as pg
from numpy.typing import NDArray
from PySide6.QtCore import Qt

from escape_gui.theme import Theme
from escape_gui.views.trends import TRENDS, hour_ticks
from escape_gui.widgets.plots import MARKERS, ErrorCurve, PlotGrid, style_axis

#: Width of the left axes at font scale 1, pixels.
_LEFT_AXIS_WIDTH = 48
#: Most marks that are drawn.
_MAX_MARKS = 60


class TrendsPlot(PlotGrid):
    """One plot per :data:`~escape_gui.views.trends.TRENDS`, with a common bottom axis."""

    def __init__(self, theme: Theme) -> None:
        super().__init__(theme)
        self._curves: Mapping[str, NDArray[np.float64]] = {}
        self._dates: Sequence[str] = ()
        self._range, self._marks = (0.0, 1.0), [(0.0, "note")][:0]
        self.setAccessibleName("Trends")
        self.build()

    def show_hours(
        self,
        curves: Mapping[str, NDArray[np.float64]],
        marks: Sequence[tuple[float, str]],
        start: float,
        end: float,
    ) -> None:
        """Show times, values and errors ``(3, n)`` by name, and marks (time, kind); Unix time in seconds."""
        rebuild = bool(self._dates)
        self._curves, self._dates, self._range = curves, (), (start, end)
        self._marks = [mark for mark in marks if start <= mark[0] <= end][-_MAX_MARKS:]
        if rebuild:
            self.build()
        else:
            self._fill()

    def show_nights(self, points: Mapping[str, NDArray[np.float64]], dates: Sequence[str]) -> None:
        """Show number of the night, median and error ``(3, n)`` by name."""
        self._curves, self._dates, self._marks = points, dates, []
        self._range = (-0.5, max(len(dates), 1) - 0.5)
        self.build()

    def build(self) -> None:
        super().build()
        self._items: dict[str, ErrorCurve | pg.PlotDataItem] = {}
        self._lines: list[tuple[pg.PlotItem, pg.InfiniteLine]] = []
        self._drawn_marks: list[tuple[float, str]] = []
        self._plots: list[pg.PlotItem] = []
        for line, trend in enumerate(TRENDS):
            plot = self.add_plot(line)
            is_last = line == len(TRENDS) - 1
            names = " ".join(self._key(k, name) for k, name in enumerate(trend.names))
            # Within the plot, since labels along the axes of low plots overlap.
            label = pg.LabelItem(
                f"{trend.label} {names}" if len(trend.names) > 1 else trend.label,
                color=self._theme.colour("text"), size=f"{self._theme.font(0.9).pointSizeF()}pt",
            )  # fmt: skip
            label.setParentItem(plot.getViewBox())
            label.anchor((0, 0), (0, 0), offset=(4, 0))
            style_axis(self._theme, plot.getAxis("left"), "")
            plot.getAxis("left").showLabel(False)
            plot.getAxis("left").setWidth(self._theme.pixels(_LEFT_AXIS_WIDTH))
            style_axis(self._theme, plot.getAxis("bottom"), "")
            plot.getAxis("bottom").showLabel(False)
            plot.getAxis("bottom").setStyle(showValues=is_last)
            for number, name in enumerate(trend.names):
                self._add_item(plot, number, name, points=trend.points or bool(self._dates))
            if self._plots:
                plot.setXLink(self._plots[0])
            self._plots.append(plot)
        self._fill()

    def _key(self, number: int, name: str) -> str:
        """Marker and name of a quantity in its colour."""
        colour = self._theme.series(number).name()
        return f"<span style='color:{colour}'>{MARKERS[number][1]} {name.removeprefix('shift_')}</span>"

    def _add_item(self, plot: pg.PlotItem, number: int, name: str, *, points: bool) -> None:
        item: ErrorCurve | pg.PlotDataItem
        if points:
            item = ErrorCurve(self._theme, number, joined=False, size=5.0)
            item.add_to(plot)
        else:
            item = pg.PlotDataItem(pen=pg.mkPen(self._theme.series(number), width=1), connect="finite")
            plot.addItem(item)
        self._items[name] = item

    def _fill(self) -> None:
        for name, item in self._items.items():
            x, y, sigma = self._curves.get(name, np.zeros((3, 0)))
            if isinstance(item, ErrorCurve):
                item.set(x, y, sigma)
            else:
                item.setData(x, y)
        for plot, trend in zip(self._plots, TRENDS, strict=True):
            # Numbers on the axis of a plot without data would be read as values.
            known = any(name in self._curves and self._curves[name].size for name in trend.names)
            plot.getAxis("left").setStyle(showValues=known)
        if self._drawn_marks != self._marks:
            self._drawn_marks = self._marks
            for plot, line in self._lines:
                plot.removeItem(line)
            self._lines = [
                (plot, self._mark(plot, at, kind)) for at, kind in self._marks for plot in self._plots
            ]
        self._plots[0].setXRange(*self._range, padding=0.01)
        step = max(1, -(-len(self._dates) // 7))
        ticks = [(k, date[5:]) for k, date in enumerate(self._dates) if k % step == 0]
        for plot in self._plots:
            plot.getAxis("bottom").setTicks([ticks or hour_ticks(*self._range)])

    def _mark(self, plot: pg.PlotItem, at: float, kind: str) -> pg.InfiniteLine:
        is_note = kind == "note"
        pen = pg.mkPen(
            self._theme.colour("muted" if is_note else "bad"), width=1,
            style=Qt.PenStyle.DotLine if is_note else Qt.PenStyle.SolidLine,
        )  # fmt: skip
        line = pg.InfiniteLine(at, pen=pen)
        # The marks do not stretch the range.
        plot.addItem(line, ignoreBounds=True)
        return line
