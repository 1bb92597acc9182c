"""Live mode maps of the interaction matrix, and one mode as every matrix sees it."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from PySide6.QtCore import Qt
from PySide6.QtGui import QKeyEvent, QResizeEvent
from PySide6.QtWidgets import (
    QCheckBox,
    QComboBox,
    QHBoxLayout,
    QLabel,
    QPushButton,
    QSizePolicy,
    QSplitter,
    QWidget,
)

from escape_gui.client.product_library import LoadedProducts
from escape_gui.panels.base import Context, ExportArray, Panel
from escape_gui.views.mode_detail import tiles
from escape_gui.views.mode_mosaic import LIMIT
from escape_gui.widgets.images.colour_scale import DIVERGING, ColourScale
from escape_gui.widgets.images.map_tiles import MapTiles
from escape_gui.widgets.images.mode_mosaic import ModeMosaic, MosaicPixel
from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.remote.source import DataSource, Sample
from escape_hw.remote.state import State
from escape_hw.report.tables import METHOD_LABELS

#: How the matrix that is being measured is called in the list.
LIVE_LABEL = "as measured now"
#: What stands below the maps until something else is to be said.
_USAGE_TEXT = "Pairs: x slopes, y slopes. Click a mode for every matrix."
#: Matrices that the detail has room for.
_MAX_MATRICES = 4
#: Shares of mosaic and detail, and the width from which on they stand beside each other.
_SPLITTER_SIZES, _SIDE_BY_SIDE_WIDTH = (550, 450), 900


class ModesPanel(Panel):
    """The mosaic, with the chosen mode's detail beside it."""

    name = "modes"
    title = "Mode maps"
    help = (
        "The x and y slopes of every mode of the interaction matrix, each mode divided by its rms slope. "
        "Click a mode to see it in every matrix at hand, with difference, error and signal-to-noise ratio."
    )
    streams: ClassVar[tuple[str, ...]] = ("valid", "matrix", "matrix_sigma")
    rate_hz = 4.0
    placeholder = (
        "No interaction matrix yet.\n\nStart DO-CRIME or ESCAPE in the Procedure panel, "
        "or open a FITS product or a run folder (Ctrl+O)."
    )

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._valid: NDArray[np.bool_] = np.zeros((0, 0), bool)
        self._live: dict[str, NDArray[np.float32]] = {}
        self._method = ""
        self._loaded = LoadedProducts()
        self._dirty = self._running = False
        self._user_selected = False
        self._make_controls()
        self._make_maps()

    # ------------------------------------------------------------ building
    def _make_controls(self) -> None:
        self.matrix_selector = QComboBox()
        self.matrix_selector.setAccessibleName("Matrix shown")
        self.matrix_selector.setSizeAdjustPolicy(QComboBox.SizeAdjustPolicy.AdjustToContents)
        self.matrix_selector.activated.connect(self._choose_matrix)
        self.fade = QCheckBox("Fade noise")
        self.fade.setChecked(True)
        self.fade.setToolTip("Draw a mode as pale as it is uncertain, by SNR² / (1 + SNR²).")
        self.fade.toggled.connect(self._redraw)
        self._previous_button, self._next_button = QPushButton("‹"), QPushButton("›")
        for button, step, words in (
            (self._previous_button, -1, "Page before"),
            (self._next_button, 1, "Next page"),
        ):
            button.setToolTip(f"{words} (Page {'Up' if step < 0 else 'Down'})")
            button.setAccessibleName(words)
            button.clicked.connect(
                lambda _=False, step=step: self.mosaic.show_page(self.mosaic.page[0] + step)
            )
        self._page_label = QLabel()
        row = QHBoxLayout()
        row.addWidget(self.matrix_selector)
        row.addWidget(self.fade)
        row.addStretch()
        for widget in (self._previous_button, self._page_label, self._next_button):
            row.addWidget(widget)
        self.body.addLayout(row)

    def _make_maps(self) -> None:
        theme = self.context.theme
        self.mosaic = ModeMosaic(theme)
        self._scale = ColourScale(theme, DIVERGING)
        self._scale.set_range(-LIMIT, LIMIT, "slope / rms slope of the mode")
        self.detail = MapTiles(theme)
        self.detail.hide()
        maps = QWidget()
        row = QHBoxLayout(maps)
        row.setContentsMargins(0, 0, 0, 0)
        row.addWidget(self.mosaic, 1)
        row.addWidget(self._scale)
        self.splitter = QSplitter(Qt.Orientation.Vertical)
        self.splitter.addWidget(maps)
        self.splitter.addWidget(self.detail)
        self.splitter.setSizes([_SPLITTER_SIZES[0], _SPLITTER_SIZES[1]])
        self.splitter.setChildrenCollapsible(False)
        self.body.addWidget(self.splitter, 1)
        self._status_label = QLabel(_USAGE_TEXT)
        self._status_label.setFont(theme.font(mono=True))
        # It must not make the panel wider than its neighbours allow.
        self._status_label.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Fixed)
        self._status_label.setWordWrap(True)
        # Two lines always, so that the maps do not change their size under the pointer.
        self._status_label.setFixedHeight(2 * self._status_label.fontMetrics().lineSpacing())
        self.body.addWidget(self._status_label)
        self.setFocusProxy(self.mosaic)
        self.mosaic.hovered.connect(self._show_hover)
        self.mosaic.chosen.connect(self._show_detail)
        self.mosaic.page_changed.connect(self._show_page)

    # ------------------------------------------------------------ data
    def on_state(self, state: State) -> None:
        """Follow what the server holds; once a measurement has ended, its product stands for it."""
        running = state.active_run is not None
        self._dirty |= running != self._running
        self._running = running
        self.context.session.library.request(state.products)

    def on_sample(self, stream: str, sample: Sample) -> None:
        """The matrix grows."""
        self._dirty = True
        if stream == "valid":
            self._valid = sample.data > 0
            return
        self._live[stream] = np.asarray(sample.data, np.float32)
        method = str(sample.meta.get("method") or sample.meta.get("stage", ""))
        self._method = METHOD_LABELS.get(method, method) or self._method
        if self._running and stream == "matrix":
            self._user_selected = False

    def tick(self, source: DataSource) -> None:
        """Draw when anything is new."""
        loaded = self.context.session.library.loaded
        if loaded is not self._loaded:
            self._loaded, self._dirty = loaded, True
        if not self._dirty:
            return
        self._dirty = False
        self._update_selector()
        if self.matrices:
            self.show_placeholder(False)
            self._redraw()

    @property
    def matrices(self) -> dict[str, InteractionMatrix]:
        """All at hand by label; the one being measured first, while it is none of the others."""
        found = dict(self._loaded.matrices)
        live = self._live_matrix()
        if live is None or (found and not self._running):
            return found
        return {LIVE_LABEL: live, **found}

    def _live_matrix(self) -> InteractionMatrix | None:
        data = self._live.get("matrix")
        if data is None or 2 * int(self._valid.sum()) != len(data):
            return None
        sigma = self._live.get("matrix_sigma")
        if sigma is None or sigma.shape != data.shape:
            sigma = np.zeros_like(data)
        unused = np.zeros((0, data.shape[1]))
        return InteractionMatrix(data, sigma, unused, self._valid, "", self._method, True, slope_unit="1")

    def _update_selector(self) -> None:
        names = list(self.matrices)
        if names == [self.matrix_selector.itemData(k) for k in range(self.matrix_selector.count())]:
            return
        now = self.matrix_selector.currentData()
        self.matrix_selector.clear()
        for name in names:
            self.matrix_selector.addItem(
                f"{self._method}, {LIVE_LABEL}" if name == LIVE_LABEL and self._method else name, name
            )
        # What is being measured comes to the front, then the newest; what somebody chose stays.
        wanted = LIVE_LABEL if LIVE_LABEL in names and self._running else (names[-1] if names else None)
        if self._user_selected and now in names:
            wanted = now
        self.matrix_selector.setCurrentIndex(max(0, self.matrix_selector.findData(wanted)))

    # ------------------------------------------------------------ showing
    def _choose_matrix(self) -> None:
        self._user_selected = True
        self._redraw()

    def _redraw(self) -> None:
        matrix = self.matrices.get(str(self.matrix_selector.currentData()))
        if matrix is None:
            return
        self.mosaic.show_matrix(matrix.valid, matrix.data, matrix.sigma, self.fade.isChecked())
        if self.detail.isVisible():
            self._show_detail(self.mosaic.mode)

    def _show_detail(self, mode: int) -> None:
        if mode < 0:
            return
        found = self.matrices
        chosen = str(self.matrix_selector.currentData())
        others = [name for name in found if name != chosen][: _MAX_MATRICES - 1]
        self.detail.show_tiles(
            tiles({name: found[name] for name in found if name in (*others, chosen)}, mode)
        )
        self.detail.show()
        self._status_label.setText(self._describe_mode(mode))

    def _describe_mode(self, mode: int) -> str:
        rms, snr = self.mosaic.statistics(mode)
        stated = f"SNR {snr:.3g}" if np.isfinite(snr) else "no error stated"
        return f"mode {mode + 1}  rms slope {rms:.3g}  {stated}"

    def _show_hover(self, spot: MosaicPixel | None) -> None:
        if spot is None:
            self._status_label.setText(
                self._describe_mode(self.mosaic.mode) if self.mosaic.mode >= 0 else _USAGE_TEXT
            )
            return
        place = f"{spot.part} {spot.value:+.3g} at ({spot.column + 1}, {spot.row + 1})"
        self._status_label.setText(f"{self._describe_mode(spot.mode)}  {place}")

    def _show_page(self, page: int, pages: int) -> None:
        self._page_label.setText(f"page {page + 1} of {pages}")
        for widget in (self._previous_button, self._page_label, self._next_button):
            widget.setVisible(pages > 1)
        self._previous_button.setEnabled(page > 0)
        self._next_button.setEnabled(page + 1 < pages)

    def keyPressEvent(self, event: QKeyEvent) -> None:
        """Escape closes the detail."""
        if event.key() == Qt.Key.Key_Escape and self.detail.isVisible():
            self.detail.hide()
        else:
            super().keyPressEvent(event)

    def resizeEvent(self, event: QResizeEvent) -> None:
        """Beside each other where there is room, else below each other."""
        super().resizeEvent(event)
        wide = self.width() >= self.context.theme.pixels(_SIDE_BY_SIDE_WIDTH)
        way = Qt.Orientation.Horizontal if wide else Qt.Orientation.Vertical
        if self.splitter.orientation() != way:
            self.splitter.setOrientation(way)
            self.splitter.setSizes([_SPLITTER_SIZES[0], _SPLITTER_SIZES[1]])

    def clear(self) -> None:
        """Forget the matrix of another source."""
        self._live.clear()
        self._user_selected = False
        self.matrix_selector.clear()
        self.detail.hide()

    def apply_theme(self) -> None:
        """Numbers keep their own letters."""
        self._status_label.setFont(self.context.theme.font(mono=True))

    def export_arrays(self) -> tuple[ExportArray, ...]:
        """The matrix in the mosaic, and its errors."""
        matrix = self.matrices.get(str(self.matrix_selector.currentData()))
        if matrix is None:
            return ()
        return (
            ExportArray("matrix", matrix.data, matrix.slope_unit),
            ExportArray("sigma", matrix.sigma, matrix.slope_unit),
        )
