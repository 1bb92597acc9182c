"""Colour maps as lookup tables, and the colour scale beside an image."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pyqtgraph as pg
from numpy.typing import NDArray
from PySide6.QtWidgets import QWidget

from escape_gui.theme import Theme
from escape_gui.widgets.layouts import column
from escape_gui.widgets.plots.plot import reparent_menu

#: Colour maps for signed values and for magnitudes, suitable for any colour vision.
DIVERGING, SEQUENTIAL = "CET-D1A", "cividis"


@lru_cache(maxsize=8)
def lookup_table(name: str) -> NDArray[np.uint8]:
    """A colour map for indices ``(256, 4)``: 0 is transparent, 1 to 255 span the map."""
    colours = np.zeros((256, 4), np.uint8)
    colours[1:] = pg.colormap.get(name).getLookupTable(0.0, 1.0, 255, alpha=True)
    return colours


class ColourScale(QWidget):
    """A vertical colour scale with numbers and a label."""

    def __init__(self, theme: Theme, name: str) -> None:
        super().__init__()
        self._theme = theme
        self._plot = pg.PlotWidget()
        reparent_menu(self._plot.getPlotItem())
        self._plot.setMouseEnabled(x=False, y=False)
        self._plot.hideButtons()
        self._plot.showAxis("right")
        for side in ("left", "bottom"):
            self._plot.hideAxis(side)
        self._image = pg.ImageItem(np.arange(1, 256, dtype=np.uint8)[:, None], axisOrder="row-major")
        self._image.setLevels((0, 255))
        self._plot.addItem(self._image)
        column(self._plot, parent=self)
        self._label = ""
        self._image.setLookupTable(lookup_table(name))
        theme.changed.connect(self.apply_theme)
        self.apply_theme()

    def set_range(self, low: float, high: float, label: str) -> None:
        self._image.setRect(0, low, 1, high - low)
        self._plot.setRange(xRange=(0, 1), yRange=(low, high), padding=0.025)
        self._label = label
        self.apply_theme()

    def apply_theme(self) -> None:
        text = self._theme.colour("text")
        self._plot.setBackground(self._theme.colour("panel"))
        axis = self._plot.getAxis("right")
        axis.setPen(self._theme.colour("line"))
        axis.setTextPen(text)
        axis.setTickFont(self._theme.font(0.9))
        axis.setLabel(
            self._label, color=text.name(), **{"font-size": f"{self._theme.font(0.9).pointSizeF()}pt"}
        )
        self.setFixedWidth(self._theme.pixels(64))
