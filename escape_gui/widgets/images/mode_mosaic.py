"""Interactive mosaic of mode maps: one image, a number above each mode, hover and click."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyqtgraph as pg
from numpy.typing import NDArray
from PySide6.QtCore import QPointF, Qt, Signal
from PySide6.QtGui import QFontMetricsF, QKeyEvent, QResizeEvent
from PySide6.QtWidgets import QWidget

from escape_gui.theme import Theme
from escape_gui.views import mode_mosaic
from escape_gui.views.mode_mosaic import ModeStatistics, MosaicLayout
from escape_gui.widgets.images.colour_scale import DIVERGING, lookup_table
from escape_gui.widgets.layouts import column

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
        theme.changed.connect(self.apply_theme)
        self.apply_theme()

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
        return self._page, mode_mosaic.pages(self._layout, self.n_modes)

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
        self._layout = mode_mosaic.fit_layout(
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
        modes = mode_mosaic.page_modes(self._layout, self.n_modes, self._page)
        values = mode_mosaic.normalise_modes(self._data, self._statistics, self._weight_by_snr)
        image = mode_mosaic.render_page(self._layout, self._valid, values, modes)
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
