"""Optical gains by mode: matrices below 1 on the left axis, those above 1 on the right one."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pyqtgraph as pg
from PySide6.QtGui import QColor

from escape_gui.theme import Theme
from escape_gui.views.gain_curves import GainCurve, axis_sides
from escape_gui.widgets.plots.plot import ErrorBand, ErrorCurve, PlotGrid, reference_line, style_axis

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
        points = ErrorCurve.make(self._theme, number, joined=False, size=5.0)
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
