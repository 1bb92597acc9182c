"""Mosaic of mode maps, grid of slope maps with titles, and their colour scale."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import pyqtgraph as pg
from numpy.typing import NDArray
from PySide6.QtCore import QPointF, QRect, QSize, Qt, Signal
from PySide6.QtGui import QFontMetricsF, QImage, QKeyEvent, QPainter, QPaintEvent, QResizeEvent
from PySide6.QtWidgets import QGridLayout, QSizePolicy, QWidget

from escape_gui.theme import Theme
from escape_gui.views import mode_maps as mode_views
from escape_gui.views.mode_maps import MapTile, ModeStatistics, MosaicLayout, colour_indices
from escape_gui.widgets.controls import ElidedLabel, column
from escape_gui.widgets.plots import reparent_menu, style_axis

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
        theme.follow(self.apply_theme)

    def set_range(self, low: float, high: float, label: str) -> None:
        self._image.setRect(0, low, 1, high - low)
        self._plot.setRange(xRange=(0, 1), yRange=(low, high), padding=0.025)
        self._label = label
        self.apply_theme()

    def apply_theme(self) -> None:
        self._plot.setBackground(self._theme.colour("panel"))
        style_axis(self._theme, self._plot.getAxis("right"), self._label)
        self.setFixedWidth(self._theme.pixels(64))


#: Height of a line of a title at font scale 1, pixels, and lines of a title.
_LINE, _TITLE_LINES = 15, 4
#: Keeps the height of a line.
_EMPTY_LINE = "\N{NO-BREAK SPACE}"


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
        self.tiles: tuple[MapTile, ...] = ()
        self._tile_widgets: list[tuple[QWidget, list[ElidedLabel], MapImage]] = []
        self._grid = QGridLayout(self)
        self._grid.setContentsMargins(4, 4, 4, 4)
        self._grid.setSpacing(8)
        theme.changed.connect(self.apply_theme)

    def resizeEvent(self, event: QResizeEvent) -> None:
        super().resizeEvent(event)
        self._arrange()

    def _arrange(self) -> None:
        title = _TITLE_LINES * self._theme.pixels(_LINE)
        columns = best_columns(len(self.tiles), self.width(), self.height(), title)
        if columns != self._columns:
            self._columns = columns
            for number, (holder, _, _) in enumerate(self._tile_widgets):
                self._grid.addWidget(holder, *divmod(number, columns))

    def show_tiles(self, tiles: Sequence[MapTile]) -> None:
        self.tiles = tuple(tiles)
        while len(self._tile_widgets) < len(self.tiles):
            self._add_tile_widget()
        for number, (holder, labels, image) in enumerate(self._tile_widgets):
            holder.setVisible(number < len(self.tiles))
            if number < len(self.tiles):
                for label, line in zip(labels, _title_lines(self.tiles[number]), strict=True):
                    label.show_text(line)
                image.show_tile(self.tiles[number])
        self._arrange()

    def _add_tile_widget(self) -> None:
        holder, labels, image = QWidget(), [ElidedLabel() for _ in range(_TITLE_LINES)], MapImage()
        column(*labels, (image, 1), parent=holder, spacing=0)
        self._grid.addWidget(holder, *divmod(len(self._tile_widgets), self._columns))
        self._tile_widgets.append((holder, labels, image))
        self._apply_fonts(labels)

    def _apply_fonts(self, labels: list[ElidedLabel]) -> None:
        for k, label in enumerate(labels):
            label.setFont(self._theme.font(0.9, bold=k == 0))
            label.setStyleSheet(f"color: {self._theme.colours.muted};" if k else "")

    def apply_theme(self) -> None:
        for _, labels, _ in self._tile_widgets:
            self._apply_fonts(labels)
        self.show_tiles(self.tiles)


def _title_lines(tile: MapTile) -> list[str]:
    """Title, numbers and colour scale of a tile, :data:`_TITLE_LINES` lines."""
    low, high = tile.limits
    scale = f"±{high:g}" if tile.signed else f"{low:g} to {high:g}"
    lines = [tile.title, *tile.note.split(", ", maxsplit=1), f"colours {scale}"]
    return lines + (_TITLE_LINES - len(lines)) * [_EMPTY_LINE]


#: Minimum width of a mode's pair of maps at font scale 1, pixels.
_MIN_MODE_WIDTH = 104
#: Font size of the modes' numbers, relative to the normal size.
_NUMBER_SCALE = 0.8


@dataclass(frozen=True, slots=True)
class MosaicPixel:
    """A pixel of a map: mode (from 0), ``x`` or ``y``, row and column of the sub-aperture, slope."""

    mode: int
    part: str
    row: int
    column: int
    value: float


class ModeMosaic(QWidget):
    """Mode maps in pages.

    The arrow keys select a mode, Page Up and Page Down change the page.
    """

    #: A :class:`MosaicPixel`, or ``None`` outside of the maps.
    hovered = Signal(object)
    #: Index of a mode, from 0.
    chosen = Signal(int)
    #: Page and number of pages, from 0.
    page_changed = Signal(int, int)

    def __init__(self, theme: Theme) -> None:
        super().__init__()
        self._theme = theme
        self._valid = np.zeros((0, 0), bool)
        self._numbers = np.zeros((0, 0), np.int64)
        self._data: NDArray[np.floating] = np.zeros((0, 0), np.float32)
        self._statistics = ModeStatistics(np.zeros(0), np.zeros(0))
        self._layout = MosaicLayout((1, 1), 1, 1)
        self._page, self._weight_by_snr = 0, True
        #: The selected mode, from 0; -1 if none.
        self.mode = -1
        self._build_view()
        theme.follow(self.apply_theme)

    def _build_view(self) -> None:
        self._view = pg.GraphicsView()
        self._box = pg.ViewBox(lockAspect=True, invertY=True, enableMenu=False, defaultPadding=0.0)
        self._box.setMouseEnabled(x=False, y=False)
        self._view.setCentralItem(self._box)
        self._image = pg.ImageItem(axisOrder="row-major")
        self._image.setLookupTable(lookup_table(DIVERGING))
        self._box.addItem(self._image)
        self._frame = pg.PlotCurveItem()
        self._box.addItem(self._frame)
        self._labels: list[pg.TextItem] = []
        column(self._view, parent=self)
        self.setFocusPolicy(Qt.FocusPolicy.StrongFocus)
        self._view.setFocusPolicy(Qt.FocusPolicy.NoFocus)
        self._view.scene().sigMouseMoved.connect(self._on_mouse_moved)
        self._view.scene().sigMouseClicked.connect(lambda event: self._on_mouse_clicked(event.scenePos()))

    @property
    def n_modes(self) -> int:
        return int(self._data.shape[1])

    @property
    def page(self) -> tuple[int, int]:
        """Page, from 0, and number of pages."""
        return self._page, mode_views.pages(self._layout, self.n_modes)

    def show_matrix(
        self,
        valid: NDArray[np.bool_],
        data: NDArray[np.floating],
        sigma: NDArray[np.floating] | None,
        weight_by_snr: bool,
    ) -> None:
        """Show a matrix ``(n_slopes, n_modes)``; ``weight_by_snr`` draws uncertain modes pale."""
        same_shape = data.shape == self._data.shape and np.array_equal(valid, self._valid)
        self._data, self._weight_by_snr = data, weight_by_snr
        self._statistics = ModeStatistics.of(data, sigma)
        if same_shape:
            self._draw()
            return
        self._valid = valid
        self._numbers = np.where(valid, np.cumsum(valid).reshape(valid.shape) - 1, -1)
        self._arrange()

    def show_page(self, page: int) -> None:
        page = max(0, min(page, self.page[1] - 1))
        if page != self._page:
            self._page = page
            self._draw(labels=True)
        self.page_changed.emit(*self.page)

    def choose(self, mode: int) -> None:
        if not 0 <= mode < self.n_modes:
            return
        self.mode = mode
        self.show_page(mode // self._layout.per_page)
        self._draw_frame()
        self.chosen.emit(mode)

    def statistics(self, mode: int) -> tuple[float, float]:
        """Rms slope and signal-to-noise ratio of a mode."""
        return float(self._statistics.rms[mode]), float(self._statistics.snr[mode])

    # ------------------------------------------------------------ drawing
    def _arrange(self) -> None:
        """Compute the layout for the size of the widget."""
        rows, columns = self._valid.shape
        self._layout = mode_views.fit_layout(
            (rows, columns),
            max(1, self.n_modes),
            (float(self.width()), float(self.height())),
            self._theme.pixels(_MIN_MODE_WIDTH),
            QFontMetricsF(self._theme.font(_NUMBER_SCALE)).ascent(),
        )
        self._page = max(0, self.mode) // self._layout.per_page
        self._draw(labels=True)
        height, width = self._layout.size
        self._box.setRange(xRange=(0, width), yRange=(0, height), padding=0)
        self.page_changed.emit(*self.page)

    def _draw(self, labels: bool = False) -> None:
        if not self.n_modes:
            self._image.clear()
            return
        modes = mode_views.page_modes(self._layout, self.n_modes, self._page)
        values = mode_views.normalise_modes(self._data, self._statistics, self._weight_by_snr)
        image = mode_views.render_page(self._layout, self._valid, values, modes)
        self._image.setImage(image, autoLevels=False, levels=(0, 255))
        if labels:
            self._place_numbers(modes)
            self._draw_frame()

    def _place_numbers(self, modes: range) -> None:
        while len(self._labels) < len(modes):
            label = pg.TextItem(anchor=(0, 0.85))
            self._labels.append(label)
            self._box.addItem(label)
        for position, label in enumerate(self._labels):
            label.setVisible(position < len(modes))
            if position < len(modes):
                top, left = self._layout.corner(position)
                label.setText(str(modes.start + position + 1), color=self._theme.colour("muted"))
                label.setFont(self._theme.font(_NUMBER_SCALE))
                label.setPos(left - 1, top)

    def _draw_frame(self) -> None:
        position = self.mode - self._page * self._layout.per_page
        if self.mode < 0 or not 0 <= position < self._layout.per_page:
            self._frame.clear()
            return
        top, left = self._layout.corner(position)
        height, width = self._layout.cell
        x, y = left - 1.5, top - self._layout.head - 1.5
        self._frame.setData(
            [x, x + width, x + width, x, x],
            [y, y, y + height, y + height, y],
            pen=pg.mkPen(self._theme.colour("accent"), width=2),
        )

    def apply_theme(self) -> None:
        self._view.setBackground(self._theme.colour("panel"))
        self._arrange()

    # ------------------------------------------------------------ mouse and keys
    def _pixel_at(self, scene_position: QPointF) -> MosaicPixel | None:
        point = self._box.mapSceneToView(scene_position)
        hit = self._layout.at(point.y(), point.x())
        if hit is None or not self.n_modes:
            return None
        position, part, row, column = hit
        mode = self._page * self._layout.per_page + position
        number = int(self._numbers[row, column])
        if mode >= self.n_modes or number < 0:
            return None
        value = self._data[number + (len(self._data) // 2 if part == "y" else 0), mode]
        return MosaicPixel(mode, part, row, column, float(value))

    def _on_mouse_moved(self, scene_position: QPointF) -> None:
        self.hovered.emit(self._pixel_at(scene_position))

    def _on_mouse_clicked(self, scene_position: QPointF) -> None:
        pixel = self._pixel_at(scene_position)
        if pixel is not None:
            self.setFocus()
            self.choose(pixel.mode)

    def keyPressEvent(self, event: QKeyEvent) -> None:
        steps = {
            Qt.Key.Key_Right: 1,
            Qt.Key.Key_Left: -1,
            Qt.Key.Key_Down: self._layout.columns,
            Qt.Key.Key_Up: -self._layout.columns,
        }
        key = Qt.Key(event.key())
        if key in steps:
            self.choose(min(max(self.mode + steps[key], 0), self.n_modes - 1))
        elif key == Qt.Key.Key_PageDown:
            self.show_page(self._page + 1)
        elif key == Qt.Key.Key_PageUp:
            self.show_page(self._page - 1)
        else:
            super().keyPressEvent(event)

    def resizeEvent(self, event: QResizeEvent) -> None:
        super().resizeEvent(event)
        self._arrange()
