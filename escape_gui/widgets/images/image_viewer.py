"""Live image with levels, cursor, logarithmic scale and marked pixels, and its tool bar."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
import pyqtgraph as pg
from numpy.typing import NDArray
from PySide6.QtCore import QPointF, QRectF, Qt, Signal
from PySide6.QtGui import QKeyEvent
from PySide6.QtWidgets import QHBoxLayout, QLabel, QSizePolicy, QToolButton, QVBoxLayout, QWidget

from escape_gui.theme import Theme

#: Colour maps for counts and magnitudes, safe for any colour vision, with lightness that only rises.
SEQUENTIAL_MAPS = ("CET-L1", "inferno", "cividis", "CET-CBL1")
#: The one for signed values: both signs stay apart in every kind of colour vision.
DIVERGING_MAPS = ("CET-D1A",)
LEVEL_UPDATE_S = 0.2
#: Pixels that are looked at for the levels, about.
_LEVEL_SAMPLE_PIXELS = 20_000
#: Decades below the brightest pixel that a logarithmic picture shows.
DECADES = 4.0
_CURSOR_STEPS = {
    Qt.Key.Key_Left: (-1, 0),
    Qt.Key.Key_Right: (1, 0),
    Qt.Key.Key_Up: (0, -1),
    Qt.Key.Key_Down: (0, 1),
}


class ImageViewer(QWidget):
    """Shows one array at a time, pixel for pixel, with the first row on top.

    Parameters
    ----------
    name
        What it shows, for screen readers.
    maps
        Names of colour maps to go through with the key M.
    symmetric
        Levels symmetric about zero.
    """

    #: Text for the line below: place and value under the cursor.
    cursor_changed = Signal(str)
    #: Column and row that were clicked.
    clicked = Signal(int, int)

    def __init__(
        self,
        theme: Theme,
        name: str,
        maps: Sequence[str] = SEQUENTIAL_MAPS,
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
        self._marks = pg.ImageItem(axisOrder="row-major")
        self._marks.setZValue(5)
        self._marks.hide()
        self.box.addItem(self._marks)
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
        self.view.scene().sigMouseMoved.connect(self._on_mouse_moved)
        self.view.scene().sigMouseClicked.connect(self._on_mouse_clicked)
        theme.changed.connect(self._apply_theme)
        self._apply_theme()
        self.image.setColorMap(pg.colormap.get(self._maps[0]))

    # ------------------------------------------------------------ data
    def show_array(self, data: NDArray[Any]) -> None:
        """Show an array ``(rows, columns)`` of integers or floats."""
        fresh = self.data is None or self.data.shape != data.shape
        self.data = data
        painted = self._display_data(data)
        now = time.monotonic()
        if fresh or (self.automatic and now >= self._levels_due):
            self._levels_due = now + LEVEL_UPDATE_S
            self.levels = self._estimate_levels(painted)
        self.image.setImage(painted, autoLevels=False, levels=self.levels)
        if fresh:
            self.reset_view()
        if self._cursor is not None:
            self._set_cursor(*self._cursor)

    def mark_pixels(self, marked: NDArray[np.bool_] | None) -> None:
        """Hatch pixels ``(rows, columns)``, such as saturated ones."""
        if marked is None or not marked.any():
            self._marks.hide()
            return
        rows, columns = np.indices(marked.shape)
        veil = np.zeros((*marked.shape, 4), np.uint8)
        striped = marked & ((rows + columns) % 2 == 0)
        veil[marked] = (255, 64, 64, 255)
        veil[striped] = (255, 255, 255, 255)
        self._marks.setImage(veil, autoLevels=False)
        self._marks.show()

    def _display_data(self, data: NDArray[Any]) -> NDArray[Any]:
        if not self.logarithmic:
            return data if data.dtype != np.float64 else data.astype(np.float32)
        top = float(np.nanmax(data)) if data.size else 1.0
        floor = max(top, 1e-30) * 10**-DECADES
        painted: NDArray[Any] = np.log10(np.maximum(data, floor), dtype=np.float32)
        return painted

    def _estimate_levels(self, painted: NDArray[Any]) -> tuple[float, float]:
        step = max(1, int(np.sqrt(painted.size / _LEVEL_SAMPLE_PIXELS)))
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
        self.data = None
        self.image.clear()
        self._marks.hide()
        self._cross.hide()

    # ------------------------------------------------------------ looking
    def reset_view(self) -> None:
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

    def set_colour_map(self, number: int) -> None:
        """Take another colour map out of its list."""
        self._map = number % len(self._maps)
        self.image.setColorMap(pg.colormap.get(self._maps[self._map]))

    # ------------------------------------------------------------ cursor and keys
    def _on_mouse_moved(self, place: QPointF) -> None:
        spot = self.image.mapFromScene(place)
        self._set_cursor(int(np.floor(spot.x())), int(np.floor(spot.y())))

    def _on_mouse_clicked(self, event: Any) -> None:
        self.setFocus()
        spot = self.image.mapFromScene(event.scenePos())
        column, row = int(np.floor(spot.x())), int(np.floor(spot.y()))
        if self.data is not None and 0 <= row < self.data.shape[0] and 0 <= column < self.data.shape[1]:
            self.clicked.emit(column, row)

    def _set_cursor(self, column: int, row: int) -> None:
        data = self.data
        if data is None or not (0 <= row < data.shape[0] and 0 <= column < data.shape[1]):
            self._cursor = None
            self.cursor_changed.emit("")
            return
        self._cursor = (column, row)
        value = data[row, column]
        text = f"{value:d}" if np.issubdtype(data.dtype, np.integer) else f"{value:.4g}"
        self.cursor_changed.emit(f"x {column:4d}  y {row:4d}  {text:>8} {self.unit}".rstrip())

    def keyPressEvent(self, event: QKeyEvent) -> None:
        key = Qt.Key(event.key())
        if key in _CURSOR_STEPS and self.data is not None:
            rows, columns = self.data.shape
            column, row = self._cursor or (columns // 2, rows // 2)
            column = min(max(column + _CURSOR_STEPS[key][0], 0), columns - 1)
            row = min(max(row + _CURSOR_STEPS[key][1], 0), rows - 1)
            self._set_cursor(column, row)
            self._cross.setPos(column + 0.5, row + 0.5)
            self._cross.show()
        elif key == Qt.Key.Key_A:
            self._levels_due = 0.0
            if self.data is not None:
                self.levels = self._estimate_levels(self._display_data(self.data))
                self.show_array(self.data)
        elif key == Qt.Key.Key_L:
            self.set_logarithmic(not self.logarithmic)
        elif key == Qt.Key.Key_R:
            self.reset_view()
        elif key == Qt.Key.Key_M:
            self.set_colour_map(self._map + 1)
        else:
            super().keyPressEvent(event)

    def focusOutEvent(self, event: Any) -> None:
        self._cross.hide()
        super().focusOutEvent(event)

    def _apply_theme(self) -> None:
        self.view.setBackground(self._theme.colours.field)
        self._cross.setPen(pg.mkPen(self._theme.colour("accent")))


class ImageToolbar(QWidget):
    """Belongs to one picture.

    Parameters
    ----------
    picture
        Its picture.
    logarithmic
        Whether the choice of a logarithmic scale makes sense.
    """

    def __init__(self, theme: Theme, picture: ImageViewer, *, logarithmic: bool = True) -> None:
        super().__init__()
        self._theme = theme
        self.cursor_value = QLabel()
        self.cursor_value.setTextFormat(Qt.TextFormat.PlainText)
        self.cursor_value.setAccessibleName("Value under the cursor")
        # A longer value must not widen the dock.
        self.cursor_value.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Preferred)
        picture.cursor_changed.connect(self.cursor_value.setText)
        row = QHBoxLayout(self)
        row.setContentsMargins(0, 0, 0, 0)
        row.setSpacing(2)
        row.addWidget(self.cursor_value, 1)
        if logarithmic:
            self.log_button = _toggle_button("log", "Logarithmic scale (L)", picture.logarithmic)
            self.log_button.toggled.connect(picture.set_logarithmic)
            row.addWidget(self.log_button)
        self.lock_scale_button = _toggle_button(
            "hold levels", "Keep black and white where they are", not picture.automatic
        )
        self.lock_scale_button.toggled.connect(lambda on: picture.set_automatic(not on))
        row.addWidget(self.lock_scale_button)
        theme.changed.connect(self._apply_theme)
        self._apply_theme()

    def _apply_theme(self) -> None:
        self.cursor_value.setFont(self._theme.font(0.9, mono=True))


def _toggle_button(text: str, tip: str, on: bool) -> QToolButton:
    button = QToolButton()
    button.setObjectName("quiet")
    button.setText(text)
    button.setToolTip(tip)
    button.setAccessibleName(tip)
    button.setCheckable(True)
    button.setChecked(on)
    return button
