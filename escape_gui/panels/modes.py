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

from escape_gui.library import Shelf
from escape_gui.panels.panel import Context, Panel, Shown
from escape_gui.views.mode_detail import tiles
from escape_gui.views.mode_mosaic import LIMIT
from escape_gui.widgets.colour_scale import SIGNED, ColourScale
from escape_gui.widgets.map_tiles import MapTiles
from escape_gui.widgets.mode_mosaic import ModeMosaic, Spot
from escape_hw.api.matrix import InteractionMatrix
from escape_hw.remote.source import Sample, Source
from escape_hw.remote.state import State
from escape_hw.report.tables import METHOD_LABELS

#: How the matrix that is being measured is called in the list.
LIVE = "as measured now"
#: What stands below the maps until something else is to be said.
_HOW = "Pairs: x slopes, y slopes. Click a mode for every matrix."
#: Matrices that the detail has room for.
_MOST = 4
#: Shares of mosaic and detail, and the width from which on they stand beside each other.
_SHARES, _WIDE = (550, 450), 900


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
    empty = (
        "No interaction matrix yet.\n\nStart DO-CRIME or ESCAPE in the Procedure panel, "
        "or open a FITS product or a run folder (Ctrl+O)."
    )

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._valid: NDArray[np.bool_] = np.zeros((0, 0), bool)
        self._live: dict[str, NDArray[np.float32]] = {}
        self._method = ""
        self._shelf = Shelf()
        self._dirty = self._running = False
        self._chosen_by_hand = False
        self._make_controls()
        self._make_maps()

    # ------------------------------------------------------------ building
    def _make_controls(self) -> None:
        self.which = QComboBox()
        self.which.setAccessibleName("Matrix shown")
        self.which.setSizeAdjustPolicy(QComboBox.SizeAdjustPolicy.AdjustToContents)
        self.which.activated.connect(self._choose_matrix)
        self.fade = QCheckBox("Fade noise")
        self.fade.setChecked(True)
        self.fade.setToolTip("Draw a mode as pale as it is uncertain, by SNR² / (1 + SNR²).")
        self.fade.toggled.connect(self._redraw)
        self._back, self._on = QPushButton("‹"), QPushButton("›")
        for button, step, words in ((self._back, -1, "Page before"), (self._on, 1, "Next page")):
            button.setToolTip(f"{words} (Page {'Up' if step < 0 else 'Down'})")
            button.setAccessibleName(words)
            button.clicked.connect(lambda _=False, step=step: self.mosaic.turn_to(self.mosaic.page[0] + step))
        self._pages = QLabel()
        row = QHBoxLayout()
        row.addWidget(self.which)
        row.addWidget(self.fade)
        row.addStretch()
        for widget in (self._back, self._pages, self._on):
            row.addWidget(widget)
        self.body.addLayout(row)

    def _make_maps(self) -> None:
        theme = self.context.theme
        self.mosaic = ModeMosaic(theme)
        self._scale = ColourScale(theme, SIGNED)
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
        self.splitter.setSizes([_SHARES[0], _SHARES[1]])
        self.splitter.setChildrenCollapsible(False)
        self.body.addWidget(self.splitter, 1)
        self._words = QLabel(_HOW)
        self._words.setFont(theme.font(mono=True))
        # It must not make the panel wider than its neighbours allow.
        self._words.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Fixed)
        self._words.setWordWrap(True)
        # Two lines always, so that the maps do not change their size under the pointer.
        self._words.setFixedHeight(2 * self._words.fontMetrics().lineSpacing())
        self.body.addWidget(self._words)
        self.setFocusProxy(self.mosaic)
        self.mosaic.hovered.connect(self._say)
        self.mosaic.chosen.connect(self._show_detail)
        self.mosaic.paged.connect(self._say_page)

    # ------------------------------------------------------------ data
    def take_state(self, state: State) -> None:
        """Follow what the server holds; once a measurement has ended, its product stands for it."""
        running = state.procedure is not None
        self._dirty |= running != self._running
        self._running = running
        self.context.session.library.want(state.products)

    def take_sample(self, stream: str, sample: Sample) -> None:
        """The matrix grows."""
        self._dirty = True
        if stream == "valid":
            self._valid = sample.data > 0
            return
        self._live[stream] = np.asarray(sample.data, np.float32)
        method = str(sample.meta.get("method") or sample.meta.get("stage", ""))
        self._method = METHOD_LABELS.get(method, method) or self._method
        if self._running and stream == "matrix":
            self._chosen_by_hand = False

    def tick(self, source: Source) -> None:
        """Draw when anything is new."""
        shelf = self.context.session.library.shelf
        if shelf is not self._shelf:
            self._shelf, self._dirty = shelf, True
        if not self._dirty:
            return
        self._dirty = False
        self._fill_list()
        if self.matrices:
            self.set_empty(False)
            self._redraw()

    @property
    def matrices(self) -> dict[str, InteractionMatrix]:
        """All at hand by label; the one being measured first, while it is none of the others."""
        found = dict(self._shelf.matrices)
        live = self._live_matrix()
        if live is None or (found and not self._running):
            return found
        return {LIVE: live, **found}

    def _live_matrix(self) -> InteractionMatrix | None:
        data = self._live.get("matrix")
        if data is None or 2 * int(self._valid.sum()) != len(data):
            return None
        sigma = self._live.get("matrix_sigma")
        if sigma is None or sigma.shape != data.shape:
            sigma = np.zeros_like(data)
        unused = np.zeros((0, data.shape[1]))
        return InteractionMatrix(data, sigma, unused, self._valid, "", self._method, True, slope_unit="1")

    def _fill_list(self) -> None:
        names = list(self.matrices)
        if names == [self.which.itemData(k) for k in range(self.which.count())]:
            return
        now = self.which.currentData()
        self.which.clear()
        for name in names:
            self.which.addItem(f"{self._method}, {LIVE}" if name == LIVE and self._method else name, name)
        # What is being measured comes to the front, then the newest; what somebody chose stays.
        wanted = LIVE if LIVE in names and self._running else (names[-1] if names else None)
        if self._chosen_by_hand and now in names:
            wanted = now
        self.which.setCurrentIndex(max(0, self.which.findData(wanted)))

    # ------------------------------------------------------------ showing
    def _choose_matrix(self) -> None:
        self._chosen_by_hand = True
        self._redraw()

    def _redraw(self) -> None:
        matrix = self.matrices.get(str(self.which.currentData()))
        if matrix is None:
            return
        self.mosaic.show_matrix(matrix.valid, matrix.data, matrix.sigma, self.fade.isChecked())
        if self.detail.isVisible():
            self._show_detail(self.mosaic.mode)

    def _show_detail(self, mode: int) -> None:
        if mode < 0:
            return
        found = self.matrices
        chosen = str(self.which.currentData())
        others = [name for name in found if name != chosen][: _MOST - 1]
        self.detail.show_tiles(
            tiles({name: found[name] for name in found if name in (*others, chosen)}, mode)
        )
        self.detail.show()
        self._words.setText(self._about(mode))

    def _about(self, mode: int) -> str:
        rms, snr = self.mosaic.statistics(mode)
        stated = f"SNR {snr:.3g}" if np.isfinite(snr) else "no error stated"
        return f"mode {mode + 1}  rms slope {rms:.3g}  {stated}"

    def _say(self, spot: Spot | None) -> None:
        if spot is None:
            self._words.setText(self._about(self.mosaic.mode) if self.mosaic.mode >= 0 else _HOW)
            return
        place = f"{spot.part} {spot.value:+.3g} at ({spot.column + 1}, {spot.row + 1})"
        self._words.setText(f"{self._about(spot.mode)}  {place}")

    def _say_page(self, page: int, pages: int) -> None:
        self._pages.setText(f"page {page + 1} of {pages}")
        for widget in (self._back, self._pages, self._on):
            widget.setVisible(pages > 1)
        self._back.setEnabled(page > 0)
        self._on.setEnabled(page + 1 < pages)

    def keyPressEvent(self, event: QKeyEvent) -> None:
        """Escape closes the detail."""
        if event.key() == Qt.Key.Key_Escape and self.detail.isVisible():
            self.detail.hide()
        else:
            super().keyPressEvent(event)

    def resizeEvent(self, event: QResizeEvent) -> None:
        """Beside each other where there is room, else below each other."""
        super().resizeEvent(event)
        wide = self.width() >= self.context.theme.pixels(_WIDE)
        way = Qt.Orientation.Horizontal if wide else Qt.Orientation.Vertical
        if self.splitter.orientation() != way:
            self.splitter.setOrientation(way)
            self.splitter.setSizes([_SHARES[0], _SHARES[1]])

    def clear(self) -> None:
        """Forget the matrix of another source."""
        self._live.clear()
        self._chosen_by_hand = False
        self.which.clear()
        self.detail.hide()

    def restyle(self) -> None:
        """Numbers keep their own letters."""
        self._words.setFont(self.context.theme.font(mono=True))

    def shown(self) -> tuple[Shown, ...]:
        """The matrix in the mosaic, and its errors."""
        matrix = self.matrices.get(str(self.which.currentData()))
        if matrix is None:
            return ()
        return (
            Shown("matrix", matrix.data, matrix.slope_unit),
            Shown("sigma", matrix.sigma, matrix.slope_unit),
        )
