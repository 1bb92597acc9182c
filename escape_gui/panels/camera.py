"""The wavefront sensor's camera: frames, slopes, where the light is too much."""

from __future__ import annotations

import time
from typing import Any, ClassVar

import numpy as np
import pyqtgraph as pg
from numpy.typing import NDArray
from PySide6.QtGui import QResizeEvent
from PySide6.QtWidgets import QHBoxLayout, QLabel, QToolButton

from escape_gui.client.availability import UNKNOWN_VALUE, has_frames
from escape_gui.panels.base import Context, ExportArray, Panel
from escape_gui.views.images import mask_from_rows, slope_map_pair
from escape_gui.widgets.controls.segmented_button import SegmentedButton
from escape_gui.widgets.images.image_viewer import DIVERGING_MAPS, SEQUENTIAL_MAPS, ImageToolbar, ImageViewer
from escape_gui.widgets.images.quiver import Quiver, outline_points
from escape_gui.widgets.plots.plot import Plot
from escape_hw.remote.source import DataSource, Sample
from escape_hw.remote.state import Geometry, State

RAW, ARROWS, MAPS, DIFFERENCE = "raw", "arrows", "x | y", "change"
_TIPS = (
    "The frame as it comes",
    "Slopes as arrows over the frame",
    "Slopes in x and in y as maps",
    "The frame minus the one that was kept",
)
_BINS = 128
_HISTOGRAM_EVERY_S = 0.2
_MAX_SAMPLED_PIXELS = 40_000
#: Pixels of height below which the histogram gives way.
_MIN_HEIGHT_FOR_HISTOGRAM = 420


class CameraPanel(Panel):
    """Frames and what is made of them."""

    name: ClassVar[str] = "camera"
    title: ClassVar[str] = "Sensor camera"
    help: ClassVar[str] = (
        "Frames of the wavefront sensor, or the slopes made of them. Saturated pixels are hatched and "
        "counted. 'Keep' remembers the frame shown, and 'change' then shows the difference to it."
    )
    streams: ClassVar[tuple[str, ...]] = ("frames", "slopes")
    rate_hz: ClassVar[float] = 30.0
    stale_after_s: ClassVar[float | None] = 1.0
    placeholder: ClassVar[str] = (
        "No frames yet.\nThey come as soon as a server has opened the sensor's camera."
    )

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        theme = context.theme
        self.choice = SegmentedButton("View of the sensor", (RAW, ARROWS, MAPS, DIFFERENCE), _TIPS)
        self.choice.chosen.connect(self._on_view_changed)
        self.set_reference_button = QToolButton()
        self.set_reference_button.setText("Keep")
        self.set_reference_button.setToolTip("Keep this frame; 'change' shows later ones minus this")
        self.set_reference_button.clicked.connect(self._set_reference)
        self.saturation = QLabel()
        head = QHBoxLayout()
        head.addWidget(self.choice)
        head.addWidget(self.set_reference_button)
        head.addStretch()
        self.picture = ImageViewer(theme, "Frame of the sensor", SEQUENTIAL_MAPS, unit="counts")
        self.signed = ImageViewer(theme, "Slopes or difference", DIVERGING_MAPS, symmetric=True)
        self.quiver = Quiver(theme)
        self.picture.box.addItem(self.quiver)
        self._outlines = pg.PlotCurveItem()
        self._outlines.setZValue(3)
        self.picture.box.addItem(self._outlines)
        self.bars = (ImageToolbar(theme, self.picture), ImageToolbar(theme, self.signed, logarithmic=False))
        self.histogram = Plot(theme, "Histogram of the frame", "counts", "pixels")
        self.histogram.setLogMode(x=False, y=True)
        self.histogram.setFixedHeight(theme.pixels(92))
        self._curve = self.histogram.curve(0, alone=True, stepMode="center")
        self.body.addLayout(head)
        for widget in (self.saturation, self.picture, self.signed, *self.bars, self.histogram):
            self.body.addWidget(widget)
        self.body.setStretchFactor(self.picture, 1)
        self.body.setStretchFactor(self.signed, 1)
        self._frame: NDArray[Any] | None = None
        self._reference: NDArray[Any] | None = None
        self._slopes: NDArray[Any] | None = None
        self._geometry = Geometry()
        self._valid = np.zeros((0, 0), bool)
        self._full_scale: float | None = None
        self._histogram_due = 0.0
        self._update_visibility()
        self.apply_theme()

    # ------------------------------------------------------------ news
    def tick(self, source: DataSource) -> None:
        """Outlines appear when the sensor was found."""
        geometry = source.geometry()
        if geometry is not self._geometry:
            self._geometry = geometry
            self._valid = mask_from_rows(geometry.valid)
            self._outlines.setData(*outline_points(geometry.outlines_px), connect="finite")
            self.quiver.set_geometry(geometry)

    def on_state(self, state: State) -> None:
        """Saturation, counted by the server over all frames."""
        light = state.illumination
        peak, saturated = f"{100 * light.peak:3.0f} %", f"{100 * light.saturated:5.2f} %"
        if not has_frames(state):
            peak = saturated = UNKNOWN_VALUE
        self.saturation.setText(f"peak {peak}   saturated {saturated}")

    def on_sample(self, stream: str, sample: Sample) -> None:
        """A frame or slopes."""
        if stream == "slopes":
            self._slopes = sample.data
            self._show_slopes()
            return
        self._frame = sample.data
        top = sample.meta.get("top")
        self._full_scale = float(top) if top is not None else None
        self._show_frame()

    def _show_frame(self) -> None:
        frame, view = self._frame, self.choice.word
        if frame is None or view == MAPS:
            return
        if view == DIFFERENCE:
            if self._reference is not None and self._reference.shape == frame.shape:
                self.signed.show_array(frame.astype(np.float32) - self._reference)
            return
        self.picture.show_array(frame)
        now = time.monotonic()
        if now >= self._histogram_due:
            self._histogram_due = now + _HISTOGRAM_EVERY_S
            self.picture.mark_pixels(None if self._full_scale is None else frame >= self._full_scale)
            self._show_histogram(frame)

    def _show_histogram(self, frame: NDArray[Any]) -> None:
        step = max(1, int(np.sqrt(frame.size / _MAX_SAMPLED_PIXELS)))
        sample = frame[::step, ::step]
        top = self._full_scale if self._full_scale is not None else float(sample.max()) + 1
        counts, edges = np.histogram(sample, bins=_BINS, range=(0, max(top, 1.0)))
        self._curve.setData(edges, counts + 0.5)

    def _show_slopes(self) -> None:
        slopes, view = self._slopes, self.choice.word
        if slopes is None or 2 * int(self._valid.sum()) != slopes.size:
            return
        if view == ARROWS:
            self.quiver.show_slopes(slopes)
        elif view == MAPS:
            self.signed.show_array(slope_map_pair(slopes, self._valid))

    # ------------------------------------------------------------ views
    def resizeEvent(self, event: QResizeEvent) -> None:
        """Little room belongs to the picture alone."""
        super().resizeEvent(event)
        self._update_visibility()

    def _update_visibility(self) -> None:
        signed = self.choice.word in (MAPS, DIFFERENCE)
        for widget in (self.picture, self.bars[0]):
            widget.setVisible(not signed)
        for widget in (self.signed, self.bars[1]):
            widget.setVisible(signed)
        self.quiver.setVisible(self.choice.word == ARROWS)
        room = self.height() >= self.context.theme.pixels(_MIN_HEIGHT_FOR_HISTOGRAM)
        self.histogram.setVisible(room and not signed)

    def _on_view_changed(self, view: str) -> None:
        self._update_visibility()
        self.signed.clear()
        if view == DIFFERENCE and self._reference is None:
            self._set_reference()
        self._show_frame()
        self._show_slopes()

    def _set_reference(self) -> None:
        if self._frame is not None:
            self._reference = self._frame.astype(np.float32)

    def clear(self) -> None:
        """Another source: nothing kept is comparable."""
        self._frame = self._reference = self._slopes = None
        self._geometry = Geometry()
        self._valid = np.zeros((0, 0), bool)
        self._outlines.setData([], [])
        self.quiver.set_geometry(self._geometry)
        self.picture.clear()
        self.signed.clear()

    def apply_theme(self) -> None:
        """Colours of what lies over the picture."""
        theme = self.context.theme
        self.saturation.setFont(theme.font(0.9, mono=True))
        self.histogram.setFixedHeight(theme.pixels(92))
        colour = theme.series(1)
        colour.setAlpha(90)
        self._outlines.setPen(pg.mkPen(colour, width=1))

    def export_arrays(self) -> tuple[ExportArray, ...]:
        """Frame and slopes as last seen."""
        parts = []
        if self._frame is not None:
            parts.append(ExportArray("frame", self._frame, "count"))
        if self._slopes is not None:
            parts.append(ExportArray("slopes", self._slopes, "pixel"))
        return tuple(parts)
