"""Pairs of maps under their titles, as many as there are, in a grid."""

from __future__ import annotations

from collections.abc import Sequence

import pyqtgraph as pg
from PySide6.QtWidgets import QVBoxLayout, QWidget

from escape_gui.theme import Theme
from escape_gui.views.mode_detail import Tile
from escape_gui.views.mode_mosaic import indices
from escape_gui.widgets.colour_scale import SIGNED, SIZE, table


class MapTiles(QWidget):
    """One mode as several matrices see it.

    Parameters
    ----------
    theme
        Colours and fonts.
    columns
        Tiles beside each other.
    """

    def __init__(self, theme: Theme, columns: int = 2) -> None:
        super().__init__()
        self._theme, self._columns = theme, columns
        self._grid = pg.GraphicsLayoutWidget()
        self._grid.ci.setContentsMargins(4, 4, 4, 4)
        self._tiles: tuple[Tile, ...] = ()
        layout = QVBoxLayout(self)
        layout.setContentsMargins(0, 0, 0, 0)
        layout.addWidget(self._grid)
        theme.changed.connect(self.restyle)
        self.restyle()

    @property
    def titles(self) -> tuple[str, ...]:
        """What is shown."""
        return tuple(one.title for one in self._tiles)

    def show_tiles(self, tiles: Sequence[Tile]) -> None:
        """Show these instead of what was shown before."""
        self._tiles = tuple(tiles)
        self._grid.clear()
        for number, tile in enumerate(self._tiles):
            row, column = divmod(number, self._columns)
            self._grid.addItem(self._title(tile), row=2 * row, col=column)
            self._grid.addItem(self._picture(tile), row=2 * row + 1, col=column)
            self._grid.ci.layout.setRowStretchFactor(2 * row, 0)
            self._grid.ci.layout.setRowStretchFactor(2 * row + 1, 1)

    def _title(self, tile: Tile) -> pg.LabelItem:
        colours = self._theme.colours
        size = self._theme.font(0.9).pointSizeF()
        low, high = tile.limits
        scale = f"±{high:g}" if tile.signed else f"{low:g} to {high:.3g}"
        return pg.LabelItem(
            f"<span style='color:{colours.text}; font-size:{size}pt'><b>{tile.title}</b></span><br>"
            f"<span style='color:{colours.muted}; font-size:{size}pt'>{tile.note} · scale {scale}</span>"
        )

    def _picture(self, tile: Tile) -> pg.ViewBox:
        box = pg.ViewBox(lockAspect=True, invertY=True, enableMenu=False, defaultPadding=0.02)
        box.setMouseEnabled(x=False, y=False)
        low, high = tile.limits
        middle, half = (low + high) / 2, (high - low) / 2
        image = pg.ImageItem(indices(tile.maps - middle, half), axisOrder="row-major", levels=(0, 255))
        image.setLookupTable(table(SIGNED if tile.signed else SIZE))
        box.addItem(image)
        return box

    def restyle(self) -> None:
        """Follow the palette."""
        self._grid.setBackground(self._theme.colour("panel"))
        self.show_tiles(self._tiles)
