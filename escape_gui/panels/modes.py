"""Live mode maps of the interaction matrix, and one mode in all matrices.

The live matrix comes from the streams of a measurement, the others from ``client.product_library``.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from PySide6.QtCore import Qt
from PySide6.QtGui import QKeyEvent, QResizeEvent
from PySide6.QtWidgets import (
    QCheckBox,
    QGridLayout,
    QLabel,
    QSizePolicy,
    QSplitter,
    QWidget,
)

from escape_gui.client.product_library import LoadedProducts
from escape_gui.panels.base import Context, ExportArray, Panel
from escape_gui.views.mode_maps import LIMIT, tiles
from escape_gui.widgets.controls import flat_button, row
from escape_gui.widgets.inputs import NameSelector
from escape_gui.widgets.mode_maps import DIVERGING, ColourScale, MapTiles, ModeMosaic, MosaicPixel
from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.remote.source import DataSource, Sample
from escape_hw.remote.state import State
from escape_hw.report.tables import METHOD_LABELS

#: Label of the matrix that is being measured.
LIVE_LABEL = "live"
_USAGE_TEXT = "Pairs: x slopes, y slopes. Click a mode to compare all matrices."
#: Width of the selector of matrices beside its text, pixels.
_SELECTOR_FRAME_PX = 40
#: Maximum number of matrices in the detail of a mode.
_MAX_MATRICES = 4
#: Sizes of mosaic and detail, and the panel width from which they are side by side; pixels.
_SPLITTER_SIZES, _SIDE_BY_SIDE_WIDTH = [550, 450], 900


class ModesPanel(Panel):
    """Mosaic of all modes, with the detail of the selected mode."""

    name = "modes"
    title = "Mode maps"
    help = (
        "The x and y slopes of each mode of the interaction matrix, divided by the rms slope of the mode. "
        "Click a mode to show it in all matrices, with difference, standard error and signal-to-noise ratio."
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
        self._running = False
        #: Label of the matrix that the user selected.
        self._selected = ""
        self._run_id = -1
        self._make_controls()
        self._make_maps()

    # ------------------------------------------------------------ construction
    def _make_controls(self) -> None:
        self.matrix_selector = NameSelector()
        self.matrix_selector.setAccessibleName("Matrix shown")
        self.matrix_selector.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Fixed)
        self.matrix_selector.currentTextChanged.connect(lambda _: self._arrange_controls())
        self.matrix_selector.activated.connect(self._choose_matrix)
        self.weight_by_snr = QCheckBox("Weight by SNR")
        self.weight_by_snr.setChecked(True)
        self.weight_by_snr.setToolTip("Scale the colours of a mode by SNR² / (1 + SNR²).")
        self.weight_by_snr.toggled.connect(self._show_mosaic)
        self._previous_button = flat_button("‹", "Previous page (Page Up)")
        self._next_button = flat_button("›", "Next page (Page Down)")
        for button, step in ((self._previous_button, -1), (self._next_button, 1)):
            button.clicked.connect(
                lambda _=False, step=step: self.mosaic.show_page(self.mosaic.page[0] + step)
            )
        self._page_label = QLabel()
        self._page_label.setToolTip("Page of the modes")
        self._page_controls = (self._previous_button, self._page_label, self._next_button)
        self._controls = QGridLayout()
        self._controls.setHorizontalSpacing(8)
        self._controls.setColumnStretch(0, 1)
        self._controls.addWidget(self.matrix_selector, 0, 0)
        self._controls.addLayout(row(*self._page_controls), 0, 2)
        self.body.addLayout(self._controls)
        self._arrange_controls()

    def _arrange_controls(self) -> None:
        """Put the check box into a line of its own where the name of the matrix would be cut."""
        selector = self.matrix_selector
        text = selector.fontMetrics().horizontalAdvance(selector.currentText())
        name = max(text + self.context.theme.pixels(_SELECTOR_FRAME_PX), selector.minimumSizeHint().width())
        others = sum(one.sizeHint().width() for one in (self.weight_by_snr, *self._page_controls))
        gaps = 4 * self._controls.horizontalSpacing() + 2 * self.body.contentsMargins().left()
        # Not the width of the panel, which the controls may widen: it would be resized without end.
        around = self.parentWidget()
        visible = self.width() if around is None else around.width()
        fits = name + others + gaps <= visible
        self._controls.addWidget(self.weight_by_snr, *((0, 1) if fits else (1, 0)))

    def _make_maps(self) -> None:
        theme = self.context.theme
        self.mosaic = ModeMosaic(theme)
        self._scale = ColourScale(theme, DIVERGING)
        self._scale.set_range(-LIMIT, LIMIT, "slope / rms slope of the mode")
        self.detail = MapTiles(theme)
        self.detail.hide()
        maps = QWidget()
        row((self.mosaic, 1), self._scale, parent=maps)
        self.splitter = QSplitter(Qt.Orientation.Vertical)
        self.splitter.addWidget(maps)
        self.splitter.addWidget(self.detail)
        self.splitter.setSizes(_SPLITTER_SIZES)
        self.splitter.setChildrenCollapsible(False)
        self.body.addWidget(self.splitter, 1)
        self._status_label = QLabel(_USAGE_TEXT)
        self._status_label.setFont(theme.font(mono=True))
        # The text must not widen the panel.
        self._status_label.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Fixed)
        self._status_label.setWordWrap(True)
        # Always two lines, so that the maps keep their size.
        self._status_label.setFixedHeight(2 * self._status_label.fontMetrics().lineSpacing())
        self.body.addWidget(self._status_label)
        self.setFocusProxy(self.mosaic)
        self.mosaic.hovered.connect(self._show_hover)
        self.mosaic.chosen.connect(self._show_detail)
        self.mosaic.page_changed.connect(self._show_page)

    # ------------------------------------------------------------ data
    def on_state(self, state: State) -> None:
        """Request the products; at the end of a measurement its product replaces the live matrix."""
        run = state.active_run if self.context.session.live else None
        if run is not None and run.id != self._run_id:
            # The maps of the run before are not what is being measured now.
            self._run_id = run.id
            self._live.clear()
        running = run is not None
        self.dirty |= running != self._running
        self._running = running
        self.context.session.library.request(state.products)

    def on_sample(self, stream: str, sample: Sample) -> None:
        self.dirty = True
        if stream == "valid":
            self._valid = sample.data > 0
            return
        self._live[stream] = np.asarray(sample.data, np.float32)
        method = str(sample.meta.get("method") or sample.meta.get("stage", ""))
        self._method = METHOD_LABELS.get(method, method) or self._method
        if self._running and stream == "matrix":
            self._selected = ""

    def tick(self, source: DataSource) -> None:
        loaded = self.context.session.library.loaded
        if loaded is not self._loaded:
            self._loaded, self.dirty = loaded, True

    def redraw(self) -> None:
        self._update_selector()
        if self.matrices:
            self.show_placeholder(False)
            self._show_mosaic()

    @property
    def matrices(self) -> dict[str, InteractionMatrix]:
        """All matrices by label; the live one first, during a measurement or if there is no other."""
        products = dict(self._loaded.matrices)
        live = self._live_matrix()
        if live is None or (products and not self._running):
            return products
        return {LIVE_LABEL: live, **products}

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
        selector, names = self.matrix_selector, list(self.matrices)
        entries = [(self._live_text if name == LIVE_LABEL else name, name) for name in names]
        if entries == [(selector.itemText(k), selector.itemData(k)) for k in range(selector.count())]:
            return
        selector.clear()
        for text, name in entries:
            selector.addItem(text, name)
        # Keep the user's choice, else the live matrix, else the newest.
        current: str | None = self._selected
        if current not in names:
            current = LIVE_LABEL if LIVE_LABEL in names and self._running else (names[-1] if names else None)
        self.matrix_selector.setCurrentIndex(max(0, self.matrix_selector.findData(current)))

    @property
    def _live_text(self) -> str:
        """Words for the matrix of the streams, which is live only while it is measured."""
        word = LIVE_LABEL if self._running else "as measured" if self.context.session.live else "recorded"
        return f"{self._method}, {word}" if self._method else word

    # ------------------------------------------------------------ display
    def _choose_matrix(self) -> None:
        self._selected = str(self.matrix_selector.currentData())
        self._show_mosaic()

    def _show_mosaic(self) -> None:
        matrix = self.matrices.get(str(self.matrix_selector.currentData()))
        if matrix is None:
            return
        self.mosaic.show_matrix(matrix.valid, matrix.data, matrix.sigma, self.weight_by_snr.isChecked())
        if self.detail.isVisible():
            self._show_detail(self.mosaic.mode)

    def _show_detail(self, mode: int) -> None:
        if mode < 0:
            return
        matrices = self.matrices
        chosen = str(self.matrix_selector.currentData())
        others = [name for name in matrices if name != chosen][: _MAX_MATRICES - 1]
        shown = {name: one for name, one in matrices.items() if name in (*others, chosen)}
        self.detail.show_tiles(tiles(shown, mode))
        self.detail.show()
        self._status_label.setText(self._describe_mode(mode))

    def _describe_mode(self, mode: int) -> str:
        rms, snr = self.mosaic.statistics(mode)
        quality = f"SNR {snr:.3g}" if np.isfinite(snr) else "no standard error"
        return f"mode {mode + 1}  rms slope {rms:.3g}  {quality}"

    def _show_hover(self, pixel: MosaicPixel | None) -> None:
        if pixel is None:
            self._status_label.setText(
                self._describe_mode(self.mosaic.mode) if self.mosaic.mode >= 0 else _USAGE_TEXT
            )
            return
        value = f"{pixel.part} {pixel.value:+.3g} at ({pixel.column + 1}, {pixel.row + 1})"
        self._status_label.setText(f"{self._describe_mode(pixel.mode)}  {value}")

    def _show_page(self, page: int, pages: int) -> None:
        self._page_label.setText(f"{page + 1} of {pages}")
        for widget in self._page_controls:
            widget.setVisible(pages > 1)
        self._arrange_controls()
        self._previous_button.setEnabled(page > 0)
        self._next_button.setEnabled(page + 1 < pages)

    def keyPressEvent(self, event: QKeyEvent) -> None:
        if event.key() == Qt.Key.Key_Escape and self.detail.isVisible():
            self.detail.hide()
        else:
            super().keyPressEvent(event)

    def resizeEvent(self, event: QResizeEvent) -> None:
        super().resizeEvent(event)
        self._arrange_controls()
        wide = self.width() >= self.context.theme.pixels(_SIDE_BY_SIDE_WIDTH)
        orientation = Qt.Orientation.Horizontal if wide else Qt.Orientation.Vertical
        if self.splitter.orientation() != orientation:
            self.splitter.setOrientation(orientation)
            self.splitter.setSizes(_SPLITTER_SIZES)

    def clear(self) -> None:
        self._live.clear()
        # The products of a source that goes on are shown again.
        self._loaded = LoadedProducts()
        self.matrix_selector.clear()
        self.detail.hide()

    def apply_theme(self) -> None:
        self._status_label.setFont(self.context.theme.font(mono=True))

    def export_arrays(self) -> tuple[ExportArray, ...]:
        matrix = self.matrices.get(str(self.matrix_selector.currentData()))
        if matrix is None:
            return ()
        return (
            ExportArray("matrix", matrix.data, matrix.slope_unit),
            ExportArray("sigma", matrix.sigma, matrix.slope_unit),
        )
