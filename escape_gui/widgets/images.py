"""Live image with cursor, marks and tool bar; slopes as arrows over it."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pyqtgraph as pg
from numpy.typing import NDArray
from PySide6.QtCore import QPointF, QRectF, Qt, Signal
from PySide6.QtGui import QAction, QActionGroup, QKeyEvent, QMouseEvent
from PySide6.QtWidgets import QLabel, QMenu, QSizePolicy, QToolButton, QWidget

from escape_gui.theme import Theme
from escape_gui.views.images import FrameAverage
from escape_gui.widgets.controls import column, flat_button, row
from escape_hw.remote.state import Geometry

#: Colour maps for counts and magnitudes, with monotonic lightness, suitable for any colour vision.
SEQUENTIAL_MAPS = ("CET-L1", "inferno", "cividis", "CET-CBL1")
#: Colour map for signed values, suitable for any colour vision.
DIVERGING_MAPS = ("CET-D1A",)
#: Stretches of the grey values: from minimum to maximum, its logarithm or square root, and between two
#: percentiles, which single bright or dark pixels do not change.
STRETCHES = ("linear", "log", "square root", "percentile")
PERCENTILES = (1.0, 99.7)
#: Numbers of frames to average.
AVERAGES = (1, 4, 16, 64, 256)
#: Period of the automatic display range, and approximate number of pixels used for it.
_LEVEL_UPDATE_S, _LEVEL_SAMPLE_PIXELS = 0.2, 20_000
#: Range of a logarithmic image below its brightest pixel, decades.
DECADES = 4.0
_CURSOR_STEPS = {
    Qt.Key.Key_Left: (-1, 0), Qt.Key.Key_Right: (1, 0), Qt.Key.Key_Up: (0, -1), Qt.Key.Key_Down: (0, 1),
}  # fmt: skip


class _ImageView(pg.GraphicsView):  # type: ignore[misc]
    double_clicked = Signal()

    def mouseDoubleClickEvent(self, event: QMouseEvent) -> None:
        event.accept()
        self.double_clicked.emit()


class ImageViewer(QWidget):
    """Shows an array with square pixels and the first row at the top.

    The key M cycles through the colour maps ``maps``. A ``symmetric`` display range is symmetric about zero,
    its upper level at least ``min_level``.
    """

    #: Position and value under the cursor, as text.
    cursor_changed = Signal(str)
    #: Column and row of a pixel that was clicked.
    pixel_clicked = Signal(int, int)
    #: Stretch, colour map or number of averaged frames were changed.
    display_changed = Signal()

    def __init__(
        self,
        theme: Theme,
        name: str,
        maps: Sequence[str] = SEQUENTIAL_MAPS,
        *,
        symmetric: bool = False,
        unit: str = "",
        min_level: float = 0.0,
    ) -> None:
        super().__init__()
        self._theme, self._maps, self._symmetric = theme, tuple(maps), symmetric
        self.unit, self._min_level = unit, min_level
        #: A second unit for the value under the cursor: factor and name.
        self.second_unit: tuple[float, str] | None = None
        #: The array shown: the mean of several if :attr:`average` is set so.
        self.data: NDArray[Any] | None = None
        self.average = FrameAverage()
        self.stretch = "linear" if symmetric else "percentile"
        #: The display range follows the data.
        self.automatic = True
        self.levels = (0.0, 1.0)
        self._levels_due = 0.0
        self._cursor: tuple[int, int] | None = None
        self._map = 0
        self.view = _ImageView()
        self.box = pg.ViewBox(lockAspect=True, invertY=True, enableMenu=False, defaultPadding=0.02)
        self.view.setCentralItem(self.box)
        self.image = pg.ImageItem(axisOrder="row-major")
        self.box.addItem(self.image)
        self._marks = pg.ImageItem(axisOrder="row-major")
        self._marks.setZValue(5)
        self._marks.hide()
        self.box.addItem(self._marks)
        self._section_lines = tuple(pg.InfiniteLine(angle=angle) for angle in (0, 90))
        for line in self._section_lines:
            line.setZValue(8)
            line.hide()
            self.box.addItem(line)
        self._cross = pg.TargetItem(movable=False, size=10)
        self._cross.setZValue(9)
        self._cross.hide()
        self.box.addItem(self._cross)
        column(self.view, parent=self)
        self.setFocusPolicy(Qt.FocusPolicy.StrongFocus)
        self.view.setFocusPolicy(Qt.FocusPolicy.NoFocus)
        self.setAccessibleName(name)
        self.setMinimumSize(96, 96)
        self.view.scene().sigMouseMoved.connect(self._on_mouse_moved)
        self.view.scene().sigMouseClicked.connect(lambda event: self._on_clicked(event.scenePos()))
        self.view.double_clicked.connect(self.reset_view)
        theme.follow(self._apply_theme)
        self.image.setColorMap(pg.colormap.get(self._maps[0]))

    # ------------------------------------------------------------ data
    def show_array(self, data: NDArray[Any]) -> None:
        """Show an array ``(rows, columns)`` of integers or floats."""
        new_shape = self.data is None or self.data.shape != data.shape
        self.data = self.average(data)
        self._draw(new_shape)

    def _draw(self, new_shape: bool = False) -> None:
        if self.data is None:
            return
        displayed = self._display_data(self.data)
        now = time.monotonic()
        if new_shape or (self.automatic and now >= self._levels_due):
            self._levels_due = now + _LEVEL_UPDATE_S
            self.levels = self._estimate_levels(displayed)
        self.image.setImage(displayed, autoLevels=False, levels=self.levels)
        if new_shape:
            self.reset_view()
        if self._cursor is not None:
            self._set_cursor(*self._cursor)

    def mark_pixels(self, marked: NDArray[np.bool_] | None) -> None:
        """Hatch the pixels of a mask ``(rows, columns)``."""
        if marked is None or not marked.any():
            self._marks.hide()
            return
        rows, columns = np.indices(marked.shape)
        hatch = np.zeros((*marked.shape, 4), np.uint8)
        hatch[marked] = (255, 64, 64, 255)
        hatch[marked & ((rows + columns) % 2 == 0)] = (255, 255, 255, 255)
        self._marks.setImage(hatch, autoLevels=False)
        self._marks.show()

    def _display_data(self, data: NDArray[Any]) -> NDArray[Any]:
        if self.stretch == "square root":
            # The square root of the light above the background.
            low = float(np.nanpercentile(data, PERCENTILES[0])) if data.size else 0.0
            root: NDArray[Any] = np.sqrt(np.maximum(data - low, 0), dtype=np.float32)
            return root
        if self.stretch != "log":
            return data if data.dtype != np.float64 else data.astype(np.float32)
        top = float(np.nanmax(data)) if data.size else 1.0
        floor = max(top, 1e-30) * 10**-DECADES
        logarithm: NDArray[Any] = np.log10(np.maximum(data, floor), dtype=np.float32)
        return logarithm

    def _estimate_levels(self, displayed: NDArray[Any]) -> tuple[float, float]:
        step = max(1, int(np.sqrt(displayed.size / _LEVEL_SAMPLE_PIXELS)))
        sample = displayed[::step, ::step]
        sample = sample[np.isfinite(sample)]
        if sample.size == 0:
            return 0.0, 1.0
        low, high = (float(value) for value in np.percentile(sample, PERCENTILES))
        if self._symmetric:
            high = max(abs(low), abs(high), self._min_level)
            low = -high
        elif self.stretch != "percentile":
            # The brightest pixel may be none of the sample.
            high = float(np.nanmax(displayed))
            low = float(np.nanmin(displayed)) if self.stretch == "linear" else low
        return (low, high) if high > low else (low - 0.5, low + 0.5)

    def mark_section(self, place: tuple[int, int] | None) -> None:
        """Mark the row and the column through a pixel (column, row)."""
        for line in self._section_lines:
            line.setVisible(place is not None)
        if place is not None:
            self._section_lines[0].setPos(place[1] + 0.5)
            self._section_lines[1].setPos(place[0] + 0.5)

    def clear(self) -> None:
        self.data = None
        self.average.clear()
        self.mark_section(None)
        self.image.clear()
        self._marks.hide()
        self._cross.hide()

    # ------------------------------------------------------------ display
    def reset_view(self) -> None:
        if self.data is not None:
            rows, columns = self.data.shape
            self.box.setRange(QRectF(0, 0, columns, rows), padding=0.02)

    @property
    def colour_map(self) -> int:
        """Number of the colour map in the list."""
        return self._map

    @property
    def colour_maps(self) -> tuple[str, ...]:
        """Names of the colour maps."""
        return self._maps

    @property
    def symmetric(self) -> bool:
        """Whether the display range is symmetric about zero."""
        return self._symmetric

    def set_stretch(self, stretch: str) -> None:
        """Use a stretch of :data:`STRETCHES`."""
        self.stretch = stretch
        self._levels_due = 0.0
        self._draw()
        self.display_changed.emit()

    def set_average(self, frames: int) -> None:
        """Show the mean of so many frames."""
        self.average.frames = frames
        self.display_changed.emit()

    def set_automatic(self, on: bool) -> None:
        """Let the display range follow the data, or lock it."""
        self.automatic = on
        self._levels_due = 0.0

    def set_colour_map(self, number: int) -> None:
        """Use colour map ``number`` of the list, cyclic."""
        self._map = number % len(self._maps)
        self.image.setColorMap(pg.colormap.get(self._maps[self._map]))
        self.display_changed.emit()

    # ------------------------------------------------------------ cursor and keys
    def _on_clicked(self, position: QPointF) -> None:
        self.setFocus()
        self._on_mouse_moved(position)
        if self._cursor is not None:
            self.pixel_clicked.emit(*self._cursor)

    def _on_mouse_moved(self, position: QPointF) -> None:
        point = self.image.mapFromScene(position)
        self._set_cursor(int(np.floor(point.x())), int(np.floor(point.y())))

    def _set_cursor(self, x: int, y: int) -> None:
        data = self.data
        if data is None or not (0 <= y < data.shape[0] and 0 <= x < data.shape[1]):
            self._cursor = None
            self.cursor_changed.emit("")
            return
        self._cursor = (x, y)
        value = data[y, x]
        text = f"{value:d}" if np.issubdtype(data.dtype, np.integer) else f"{value:.4g}"
        second = (
            "" if self.second_unit is None else f" = {self.second_unit[0] * value:.4g} {self.second_unit[1]}"
        )
        self.cursor_changed.emit(f"x {x:4d}  y {y:4d}  {text:>8} {self.unit}".rstrip() + second)

    def keyPressEvent(self, event: QKeyEvent) -> None:
        """Keys of :data:`escape_gui.window.actions.IMAGE_KEYS`."""
        key = Qt.Key(event.key())
        if key in _CURSOR_STEPS and self.data is not None:
            rows, columns = self.data.shape
            x, y = self._cursor or (columns // 2, rows // 2)
            x = min(max(x + _CURSOR_STEPS[key][0], 0), columns - 1)
            y = min(max(y + _CURSOR_STEPS[key][1], 0), rows - 1)
            self._set_cursor(x, y)
            self._cross.setPos(x + 0.5, y + 0.5)
            self._cross.show()
        elif key == Qt.Key.Key_A:
            self._levels_due = 0.0
            if self.data is not None:
                self.levels = self._estimate_levels(self._display_data(self.data))
                self._draw()
        elif key in (Qt.Key.Key_Return, Qt.Key.Key_Enter) and self._cursor is not None:
            self.pixel_clicked.emit(*self._cursor)
        elif key == Qt.Key.Key_L and not self._symmetric:
            self.set_stretch("percentile" if self.stretch == "log" else "log")
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
        for k, line in enumerate(self._section_lines):
            colour = self._theme.series(k)
            colour.setAlpha(140)
            line.setPen(pg.mkPen(colour, width=1))


class ImageToolbar(QWidget):
    """Value under the cursor, and a menu of stretch, colours and average.

    ``linked`` are further images that follow the menu.
    """

    def __init__(self, theme: Theme, image_view: ImageViewer, linked: Sequence[ImageViewer] = ()) -> None:
        super().__init__()
        self._theme, self._view, self._all = theme, image_view, (image_view, *linked)
        self.cursor_value = QLabel()
        self.cursor_value.setTextFormat(Qt.TextFormat.PlainText)
        self.cursor_value.setAccessibleName("Value under the cursor")
        # A long value must not widen the dock.
        self.cursor_value.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Preferred)
        for view in self._all:
            view.cursor_changed.connect(self.cursor_value.setText)
        self.display_button = flat_button("", "Stretch, colours and average of the image")
        self.display_button.setPopupMode(QToolButton.ToolButtonPopupMode.InstantPopup)
        self.menu = QMenu(self.display_button)
        #: Entries by the kind of choice and its value.
        self.choices: dict[tuple[str, object], QAction] = {}
        if not image_view.symmetric:
            self._add_choices("stretch", STRETCHES, lambda view, value: view.set_stretch(value))
        self._add_choices(
            "colour map", range(len(image_view.colour_maps)), lambda view, k: view.set_colour_map(k)
        )
        self._add_choices("average", AVERAGES, lambda view, n: view.set_average(n))
        self.display_button.setMenu(self.menu)
        lock = flat_button("Lock scale", "Lock the display range", checkable=True)
        for view in self._all:
            lock.toggled.connect(lambda on, view=view: view.set_automatic(not on))
        row((self.cursor_value, 1), self.display_button, lock, parent=self, spacing=2)
        image_view.display_changed.connect(self._show_choices)
        self._show_choices()
        theme.follow(self._apply_theme)

    def _add_choices(
        self, kind: str, values: Sequence[Any], apply: Callable[[ImageViewer, Any], None]
    ) -> None:
        if len(values) < 2:
            return
        self.menu.addSection(kind.capitalize())
        group = QActionGroup(self.menu)
        names = {"colour map": self._view.colour_maps, "average": [f"{n} frames" for n in values]}
        for value, text in zip(values, names.get(kind, values), strict=True):
            action = self.menu.addAction("no average" if text == "1 frames" else str(text))
            action.setCheckable(True)
            group.addAction(action)
            action.triggered.connect(lambda _=False, value=value: self._apply(apply, value))
            self.choices[kind, value] = action

    def _apply(self, apply: Callable[[ImageViewer, Any], None], value: Any) -> None:
        for view in self._all:
            apply(view, value)

    def _show_choices(self) -> None:
        view, frames = self._view, self._view.average.frames
        for key in (("stretch", view.stretch), ("colour map", view.colour_map), ("average", frames)):
            if key in self.choices:
                self.choices[key].setChecked(True)
        mean = f"mean of {frames}" if frames > 1 else ""
        stretch = "" if view.symmetric else view.stretch
        self.display_button.setText(", ".join(one for one in (stretch, mean) if one) or "Display")

    def _apply_theme(self) -> None:
        self.cursor_value.setFont(self._theme.font(0.9, mono=True))


#: Up to this number, outlines are the circular pupils of a pyramid sensor.
_MAX_PUPILS = 8
#: Length of the arrow of a slope of one pixel, in half widths of a sub-aperture.
_ARROW_SCALE = 0.8


class Quiver(pg.PlotCurveItem):  # type: ignore[misc]
    """Arrows that start at the centres of the sub-apertures."""

    def __init__(self, theme: Theme) -> None:
        super().__init__()
        self._theme = theme
        self._x = self._y = np.zeros(0)
        self._length = 1.0
        self.setZValue(4)
        self.setVisible(False)
        theme.follow(self.apply_theme)

    def set_geometry(self, geometry: Geometry) -> None:
        outlines = np.asarray(geometry.outlines_px, float).reshape(-1, 3)
        self._x, self._y = outlines[:, 0], outlines[:, 1]
        self._length = _ARROW_SCALE * float(outlines[:, 2].mean()) if len(outlines) else 1.0
        self.setData([], [])

    def show_slopes(self, slopes: NDArray[np.floating]) -> None:
        """Show slopes ``(2 * n,)`` in pixels, all x, then all y; nothing if their number does not match."""
        n = self._x.size
        if slopes.size != 2 * n or n == 0:
            self.setData([], [])
            return
        x, y = np.repeat(self._x, 2), np.repeat(self._y, 2)
        x[1::2] += self._length * slopes[:n]
        y[1::2] += self._length * slopes[n:]
        self.setData(x, y, connect="pairs")

    def apply_theme(self) -> None:
        self.setPen(pg.mkPen(self._theme.series(0), width=1))


def outline_points(outlines: Sequence[tuple[float, float, float]]) -> NDArray[np.float64]:
    """Squares around sub-apertures, or circles around the pupils of a pyramid sensor.

    Points ``(2, n_points)``, NaN between the outlines, from centre x, y and half width of each in pixels.
    """
    circles = len(outlines) <= _MAX_PUPILS
    angle = np.linspace(0, 2 * np.pi, 49) if circles else np.pi / 4 + np.linspace(0, 2 * np.pi, 5)
    radius = 1.0 if circles else np.sqrt(2)
    shape = np.append(radius * np.exp(1j * angle), np.nan)
    table = np.asarray(outlines, float).reshape(-1, 3)
    points = (table[:, :1] + 1j * table[:, 1:2] + table[:, 2:] * shape).ravel()
    return np.stack([points.real, points.imag])
