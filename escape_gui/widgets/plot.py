"""Plots with units, one look, and no menus of their own."""

from __future__ import annotations

from typing import Any

import pyqtgraph as pg
from PySide6.QtCore import Qt

from escape_gui.theme import Theme
from escape_gui.widgets.ownership import own_menu

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
    theme
        Colours and fonts.
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
        own_menu(self.getPlotItem())
        self.hideButtons()
        self.setMouseEnabled(x=False, y=False)
        self.setFocusPolicy(Qt.FocusPolicy.NoFocus)
        self.setMinimumSize(120, 64)
        for side in ("left", "bottom"):
            axis = self.getAxis(side)
            axis.enableAutoSIPrefix(False)
        theme.changed.connect(self.restyle)
        self.restyle()

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

    def restyle(self) -> None:
        """Take the theme's colours and fonts."""
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
