"""Grid of slope maps with titles."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from PySide6.QtCore import QRect, QSize, Qt
from PySide6.QtGui import QImage, QPainter, QPaintEvent, QResizeEvent
from PySide6.QtWidgets import QGridLayout, QLabel, QSizePolicy, QWidget

from escape_gui.theme import Theme
from escape_gui.views.mode_detail import MapTile
from escape_gui.views.mode_mosaic import colour_indices
from escape_gui.widgets.images.colour_scale import DIVERGING, SEQUENTIAL, lookup_table
from escape_gui.widgets.layouts import column

#: Height of a line of a title at font scale 1, pixels.
_LINE = 14


def best_columns(count: int, width: float, height: float, title: float) -> int:
    """Number of columns for which ``count`` images with an aspect ratio of 2 : 1 are largest.

    ``width`` and ``height`` are those of the grid, ``title`` is the height above each image, in pixels.
    """

    def size(columns: int) -> float:
        rows = -(-max(count, 1) // columns)
        return min(width / columns / 2, height / rows - title)

    return max(range(1, max(count, 1) + 1), key=size)


class MapImage(QWidget):
    """An image with square pixels, as large as the widget permits."""

    def __init__(self) -> None:
        super().__init__()
        self._pixels: NDArray[np.uint8] = np.zeros((0, 0, 4), np.uint8)
        self.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Expanding)
        self.setMinimumHeight(32)

    def show_tile(self, tile: MapTile) -> None:
        low, high = tile.limits
        centred = tile.maps - (low + high) / 2
        colours = lookup_table(DIVERGING if tile.signed else SEQUENTIAL)
        self._pixels = np.ascontiguousarray(colours[colour_indices(centred, (high - low) / 2)])
        self.update()

    def sizeHint(self) -> QSize:
        rows, columns = self._pixels.shape[:2]
        return QSize(columns, rows)

    def paintEvent(self, event: QPaintEvent) -> None:
        rows, columns = self._pixels.shape[:2]
        if not rows:
            return
        image = QImage(self._pixels.data, columns, rows, 4 * columns, QImage.Format.Format_RGBA8888)
        size = QSize(columns, rows).scaled(self.size(), Qt.AspectRatioMode.KeepAspectRatio)
        corner = QRect(0, 0, size.width(), size.height())
        corner.moveCenter(self.rect().center())
        QPainter(self).drawImage(corner, image)


class MapTiles(QWidget):
    """Tiles of one mode in a grid."""

    def __init__(self, theme: Theme) -> None:
        super().__init__()
        self._theme, self._columns = theme, 2
        self._tiles: tuple[MapTile, ...] = ()
        self._tile_widgets: list[tuple[QWidget, QLabel, MapImage]] = []
        self._grid = QGridLayout(self)
        self._grid.setContentsMargins(4, 4, 4, 4)
        self._grid.setSpacing(8)
        theme.changed.connect(self.apply_theme)

    @property
    def titles(self) -> tuple[str, ...]:
        return tuple(one.title for one in self._tiles)

    def resizeEvent(self, event: QResizeEvent) -> None:
        super().resizeEvent(event)
        self._arrange()

    def _arrange(self) -> None:
        title = 4 * self._theme.pixels(_LINE)
        columns = best_columns(len(self._tiles), self.width(), self.height(), title)
        if columns != self._columns:
            self._columns = columns
            for number, (holder, _, _) in enumerate(self._tile_widgets):
                self._grid.addWidget(holder, *divmod(number, columns))

    def show_tiles(self, tiles: Sequence[MapTile]) -> None:
        self._tiles = tuple(tiles)
        while len(self._tile_widgets) < len(self._tiles):
            self._add_tile_widget()
        for number, (holder, title, image) in enumerate(self._tile_widgets):
            holder.setVisible(number < len(self._tiles))
            if number < len(self._tiles):
                title.setText(self._title(self._tiles[number]))
                image.show_tile(self._tiles[number])
        self._arrange()

    def _add_tile_widget(self) -> None:
        holder, title, image = QWidget(), QLabel(), MapImage()
        title.setWordWrap(True)
        title.setFont(self._theme.font(0.9))
        # Titles wrap, so that all columns have the same width.
        title.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Minimum)
        column(title, (image, 1), parent=holder, spacing=2)
        self._grid.addWidget(holder, *divmod(len(self._tile_widgets), self._columns))
        self._tile_widgets.append((holder, title, image))

    def _title(self, tile: MapTile) -> str:
        low, high = tile.limits
        scale = f"±{high:g}" if tile.signed else f"{low:g} to {high:g}"
        muted = self._theme.colours.muted
        return f"<b>{tile.title}</b><br><span style='color:{muted}'>{tile.note}<br>colours {scale}</span>"

    def apply_theme(self) -> None:
        for _, title, _ in self._tile_widgets:
            title.setFont(self._theme.font(0.9))
        self.show_tiles(self._tiles)
