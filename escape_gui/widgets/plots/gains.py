"""Optical gains by mode: matrices below 1 on the left axis, those above 1 on the right (paper)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pyqtgraph as pg
from PySide6.QtGui import QColor
from PySide6.QtWidgets import QVBoxLayout, QWidget

from escape_gui.theme import Theme
from escape_gui.views.gain_curves import GainCurve, axis_sides
from escape_gui.widgets.plots.plot import ErrorBand, ErrorCurve, add_plot, clear, reference_line, style_axis

#: Rounds of the bootstrap before the last are drawn so faintly.
_EARLIER_ROUNDS_ALPHA = 0.45


class GainsPlot(QWidget):
    """Raw points with error bars, their smooth course, and a line at 1 on each axis."""

    def __init__(self, theme: Theme) -> None:
        super().__init__()
        self._theme = theme
        self._curves: dict[str, GainCurve] = {}
        self._rounds = True
        self._graphics = pg.GraphicsLayoutWidget()
        layout = QVBoxLayout(self)
        layout.setContentsMargins(0, 0, 0, 0)
        layout.addWidget(self._graphics)
        theme.changed.connect(self._build)
        self._build()

    @property
    def labels(self) -> dict[str, str]:
        """Axis of every curve shown, by its label."""
        return axis_sides(self._curves)

    def show_rounds(self, on: bool) -> None:
        """Draw the earlier rounds of the bootstrap as well."""
        if on != self._rounds:
            self._rounds = on
            self._build()

    def show_curves(self, curves: Mapping[str, GainCurve]) -> None:
        """Show these."""
        self._curves = dict(curves)
        if self._item_layout() != self._built:
            self._build()
        else:
            self._fill()

    def _item_layout(self) -> object:
        """What the items in the plot depend on, beside their numbers."""
        rounds = {label: len(curve.rounds) for label, curve in self._curves.items()}
        return axis_sides(self._curves), rounds if self._rounds else None

    def _build(self) -> None:
        self._built = self._item_layout()
        clear(self._graphics)
        self._graphics.setBackground(self._theme.colour("field"))
        self._plot = add_plot(self._graphics)
        on = axis_sides(self._curves)
        self._second = self._add_second(on) if "right" in on.values() else None
        style_axis(self._theme, self._plot.getAxis("bottom"), "Mode")
        style_axis(
            self._theme, self._plot.getAxis("left"), _axis_label(on, "left"), colour=self._colour(on, "left")
        )
        self._plot.addItem(reference_line(self._theme, 1.0, horizontal=True, colour=self._colour(on, "left")))
        self._items: dict[str, tuple[list[pg.PlotCurveItem], ErrorCurve, ErrorBand]] = {}
        for number, label in enumerate(self._curves):
            right = on[label] == "right" and self._second is not None
            self._items[label] = self._add(self._second if right else self._plot, number, self._curves[label])
        self._fill()

    def _add(
        self, box: pg.PlotItem | pg.ViewBox, number: int, curve: GainCurve
    ) -> tuple[list[pg.PlotCurveItem], ErrorCurve, ErrorBand]:
        colour = self._theme.series(number)
        faint = QColor(colour)
        faint.setAlphaF(_EARLIER_ROUNDS_ALPHA)
        earlier = max(0, len(curve.rounds) - 1) if self._rounds else 0
        rounds = [pg.PlotCurveItem(pen=pg.mkPen(faint, width=1), connect="finite") for _ in range(earlier)]
        points, smooth = (
            ErrorCurve.make(self._theme, number, joined=False, size=5.0),
            ErrorBand(colour, width=2.0),
        )
        for one in rounds:
            box.addItem(one)
        points.add_to(box)
        smooth.add_to(box)
        return rounds, points, smooth

    def _fill(self) -> None:
        for label, (rounds, points, smooth) in self._items.items():
            curve = self._curves[label]
            for item, earlier in zip(rounds, curve.rounds, strict=False):
                item.setData(curve.modes, earlier)
            points.set(curve.modes, curve.value, curve.sigma)
            smooth.set(curve.modes, curve.trend, curve.trend_sigma)
        self._set_ranges(axis_sides(self._curves))

    def _add_second(self, on: Mapping[str, str]) -> pg.ViewBox:
        """A second pair of axes over the first, with the same modes below."""
        box = pg.ViewBox(enableMenu=False)
        box.setMouseEnabled(x=False, y=False)
        self._plot.showAxis("right")
        self._plot.scene().addItem(box)
        axis = self._plot.getAxis("right")
        axis.linkToView(box)
        axis.setGrid(False)
        box.setXLink(self._plot)
        style_axis(self._theme, axis, _axis_label(on, "right"), colour=self._colour(on, "right"))
        main = self._plot.getViewBox()
        main.sigResized.connect(lambda: box.setGeometry(main.sceneBoundingRect()))
        box.setGeometry(main.sceneBoundingRect())
        box.addItem(reference_line(self._theme, 1.0, horizontal=True, colour=self._colour(on, "right")))
        return box

    def _set_ranges(self, on: Mapping[str, str]) -> None:
        """Every axis around its own curves, the line at 1 always on it."""
        count = max((curve.value.size for curve in self._curves.values()), default=1)
        self._plot.setXRange(0.5, count + 0.5, padding=0.01)
        for side, box in (("left", self._plot.getViewBox()), ("right", self._second)):
            values = [one for label, one in self._curves.items() if on[label] == side]
            if box is not None and values:
                box.setYRange(*_y_range(values), padding=0.04)

    def _colour(self, on: Mapping[str, str], side: str) -> QColor | None:
        """An axis that one curve alone is read on takes its colour."""
        numbers = [number for number, label in enumerate(on) if on[label] == side]
        return self._theme.series(numbers[0]) if len(numbers) == 1 and len(on) > 1 else None


def _axis_label(on: Mapping[str, str], side: str) -> str:
    """The legend says which curve is read where; an axis has no room for names."""
    return f"Optical gain, {side}" if len(set(on.values())) > 1 else "Optical gain"


def _y_range(curves: list[GainCurve]) -> tuple[float, float]:
    """Lowest and highest point with its error; a few wild points do not stretch it."""
    every = np.concatenate([one.trend for one in curves] + [one.value for one in curves] + [np.ones(1)])
    known = every[np.isfinite(every)]
    low, high = np.percentile(known, (0.5, 99.5))
    return float(min(low, 1.0)), float(max(high, 1.0))
