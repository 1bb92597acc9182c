"""A live picture: fixed levels that follow slowly, cursor value, logarithmic scale, marks for bad pixels."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
import pyqtgraph as pg
from numpy.typing import NDArray
from PySide6.QtCore import QPointF, QRectF, Qt, Signal
from PySide6.QtGui import QKeyEvent
from PySide6.QtWidgets import QVBoxLayout, QWidget

from escape_gui.theme import Theme

#: Colour maps for counts and magnitudes, safe for any colour vision, with lightness that only rises.
COUNTS = ("CET-L1", "inferno", "cividis", "CET-CBL1")
#: The one for signed values: both signs stay apart in every kind of colour vision.
SIGNED = ("CET-D1A",)
LEVELS_EVERY_S = 0.2
#: Pixels that are looked at for the levels, about.
_SAMPLED = 20_000
#: Decades below the brightest pixel that a logarithmic picture shows.
DECADES = 4.0
_STEPS = {
    Qt.Key.Key_Left: (-1, 0),
    Qt.Key.Key_Right: (1, 0),
    Qt.Key.Key_Up: (0, -1),
    Qt.Key.Key_Down: (0, 1),
}


class Picture(QWidget):
    """Shows one array at a time, pixel for pixel, with the first row on top.

    Parameters
    ----------
    theme
        Colours.
    name
        What it shows, for screen readers.
    maps
        Names of colour maps to go through with the key M.
    symmetric
        Levels symmetric about zero.
    """

    #: Text for the line below: place and value under the cursor.
    pointed = Signal(str)
    #: Column and row that were clicked.
    clicked = Signal(int, int)

    def __init__(
        self,
        theme: Theme,
        name: str,
        maps: Sequence[str] = COUNTS,
        *,
        symmetric: bool = False,
        unit: str = "",
    ) -> None:
        super().__init__()
        self._theme, self._maps, self._symmetric = theme, tuple(maps), symmetric
        #: Unit of the values, said with the one under the cursor.
        self.unit = unit
        #: Levels never lie closer than this.
        self.floor = 0.0
        self.data: NDArray[Any] | None = None
        self.logarithmic = False
        #: Levels follow the data; otherwise they stay.
        self.automatic = True
        self.levels = (0.0, 1.0)
        self._levels_due = 0.0
        self._cursor: tuple[int, int] | None = None
        self._map = 0
        self.view = pg.GraphicsView()
        self.box = pg.ViewBox(lockAspect=True, invertY=True, enableMenu=False, defaultPadding=0.02)
        self.view.setCentralItem(self.box)
        self.image = pg.ImageItem(axisOrder="row-major")
        self.box.addItem(self.image)
        self._veil = pg.ImageItem(axisOrder="row-major")
        self._veil.setZValue(5)
        self._veil.hide()
        self.box.addItem(self._veil)
        self._cross = pg.TargetItem(movable=False, size=10)
        self._cross.setZValue(9)
        self._cross.hide()
        self.box.addItem(self._cross)
        column = QVBoxLayout(self)
        column.setContentsMargins(0, 0, 0, 0)
        column.addWidget(self.view)
        self.setFocusPolicy(Qt.FocusPolicy.StrongFocus)
        self.view.setFocusPolicy(Qt.FocusPolicy.NoFocus)
        self.setAccessibleName(name)
        self.setMinimumSize(96, 96)
        self.view.scene().sigMouseMoved.connect(self._moved)
        self.view.scene().sigMouseClicked.connect(self._clicked)
        theme.changed.connect(self._restyle)
        self._restyle()
        self.image.setColorMap(pg.colormap.get(self._maps[0]))

    # ------------------------------------------------------------ data
    def show_array(self, data: NDArray[Any]) -> None:
        """Show an array ``(rows, columns)`` of integers or floats."""
        fresh = self.data is None or self.data.shape != data.shape
        self.data = data
        painted = self._painted(data)
        now = time.monotonic()
        if fresh or (self.automatic and now >= self._levels_due):
            self._levels_due = now + LEVELS_EVERY_S
            self.levels = self._find_levels(painted)
        self.image.setImage(painted, autoLevels=False, levels=self.levels)
        if fresh:
            self.whole()
        if self._cursor is not None:
            self._point(*self._cursor)

    def show_veil(self, marked: NDArray[np.bool_] | None) -> None:
        """Hatch pixels ``(rows, columns)``, such as saturated ones."""
        if marked is None or not marked.any():
            self._veil.hide()
            return
        rows, columns = np.indices(marked.shape)
        veil = np.zeros((*marked.shape, 4), np.uint8)
        striped = marked & ((rows + columns) % 2 == 0)
        veil[marked] = (255, 64, 64, 255)
        veil[striped] = (255, 255, 255, 255)
        self._veil.setImage(veil, autoLevels=False)
        self._veil.show()

    def _painted(self, data: NDArray[Any]) -> NDArray[Any]:
        if not self.logarithmic:
            return data if data.dtype != np.float64 else data.astype(np.float32)
        top = float(np.nanmax(data)) if data.size else 1.0
        floor = max(top, 1e-30) * 10**-DECADES
        painted: NDArray[Any] = np.log10(np.maximum(data, floor), dtype=np.float32)
        return painted

    def _find_levels(self, painted: NDArray[Any]) -> tuple[float, float]:
        step = max(1, int(np.sqrt(painted.size / _SAMPLED)))
        sample = painted[::step, ::step]
        sample = sample[np.isfinite(sample)]
        if sample.size == 0:
            return 0.0, 1.0
        low, high = (float(value) for value in np.percentile(sample, (1.0, 99.7)))
        if self._symmetric:
            high = max(abs(low), abs(high), self.floor)
            low = -high
        elif self.logarithmic:
            high = float(sample.max())
        return (low, high) if high > low else (low - 0.5, low + 0.5)

    def clear(self) -> None:
        """Show nothing."""
        self.data = None
        self.image.clear()
        self._veil.hide()
        self._cross.hide()

    # ------------------------------------------------------------ looking
    def whole(self) -> None:
        """The whole picture again."""
        if self.data is not None:
            rows, columns = self.data.shape
            self.box.setRange(QRectF(0, 0, columns, rows), padding=0.02)

    def set_logarithmic(self, on: bool) -> None:
        """Logarithmic or linear grey scale."""
        self.logarithmic = on
        self._levels_due = 0.0
        if self.data is not None:
            self.show_array(self.data)

    def set_automatic(self, on: bool) -> None:
        """Let the levels follow the data, or keep them."""
        self.automatic = on
        self._levels_due = 0.0

    def use_map(self, number: int) -> None:
        """Take another colour map out of its list."""
        self._map = number % len(self._maps)
        self.image.setColorMap(pg.colormap.get(self._maps[self._map]))

    # ------------------------------------------------------------ cursor and keys
    def _moved(self, place: QPointF) -> None:
        spot = self.image.mapFromScene(place)
        self._point(int(np.floor(spot.x())), int(np.floor(spot.y())))

    def _clicked(self, event: Any) -> None:
        self.setFocus()
        spot = self.image.mapFromScene(event.scenePos())
        column, row = int(np.floor(spot.x())), int(np.floor(spot.y()))
        if self.data is not None and 0 <= row < self.data.shape[0] and 0 <= column < self.data.shape[1]:
            self.clicked.emit(column, row)

    def _point(self, column: int, row: int) -> None:
        data = self.data
        if data is None or not (0 <= row < data.shape[0] and 0 <= column < data.shape[1]):
            self._cursor = None
            self.pointed.emit("")
            return
        self._cursor = (column, row)
        value = data[row, column]
        text = f"{value:d}" if np.issubdtype(data.dtype, np.integer) else f"{value:.4g}"
        self.pointed.emit(f"x {column:4d}  y {row:4d}  {text:>8} {self.unit}".rstrip())

    def keyPressEvent(self, event: QKeyEvent) -> None:
        """Keys of pictures, see :mod:`escape_gui.key_map`."""
        key = Qt.Key(event.key())
        if key in _STEPS and self.data is not None:
            rows, columns = self.data.shape
            column, row = self._cursor or (columns // 2, rows // 2)
            column = min(max(column + _STEPS[key][0], 0), columns - 1)
            row = min(max(row + _STEPS[key][1], 0), rows - 1)
            self._point(column, row)
            self._cross.setPos(column + 0.5, row + 0.5)
            self._cross.show()
        elif key == Qt.Key.Key_A:
            self._levels_due = 0.0
            if self.data is not None:
                self.levels = self._find_levels(self._painted(self.data))
                self.show_array(self.data)
        elif key == Qt.Key.Key_L:
            self.set_logarithmic(not self.logarithmic)
        elif key == Qt.Key.Key_R:
            self.whole()
        elif key == Qt.Key.Key_M:
            self.use_map(self._map + 1)
        else:
            super().keyPressEvent(event)

    def focusOutEvent(self, event: Any) -> None:
        """Without the focus no cross."""
        self._cross.hide()
        super().focusOutEvent(event)

    def _restyle(self) -> None:
        self.view.setBackground(self._theme.colours.field)
        self._cross.setPen(pg.mkPen(self._theme.colour("accent")))
