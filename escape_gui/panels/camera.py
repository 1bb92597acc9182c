"""Camera of the wavefront sensor: frames, slopes, saturation."""

from __future__ import annotations

import time
from typing import Any, ClassVar

import numpy as np
import pyqtgraph as pg
from numpy.typing import NDArray
from PySide6.QtCore import Signal
from PySide6.QtGui import QResizeEvent
from PySide6.QtWidgets import QLabel, QToolButton

from escape_gui.client.availability import UNKNOWN_VALUE, has_frames
from escape_gui.panels.base import Context, ExportArray, Panel
from escape_gui.views.images import mask_from_rows, slope_map_pair
from escape_gui.widgets.controls import SegmentedButton, flat_button, row
from escape_gui.widgets.images import (
    DIVERGING_MAPS,
    SEQUENTIAL_MAPS,
    ImageToolbar,
    ImageViewer,
    Quiver,
    outline_points,
)
from escape_gui.widgets.plots import Plot, SectionPlot
from escape_hw.remote.source import Sample
from escape_hw.remote.state import State

RAW, ARROWS, MAPS, DIFFERENCE = "raw", "arrows", "x | y", "difference"
HISTOGRAM, SECTION = "histogram", "section"
_PLOT_TIPS = (
    "Number of pixels by brightness",
    "Row and column through the pixel that was clicked, at first the brightest; a double click returns to it",
)
_TIPS = (
    "Raw frame", "Slopes as arrows over the frame", "Slopes in x and y as maps", "Frame minus the reference",
)  # fmt: skip
_BINS = 128
_HISTOGRAM_PERIOD_S = 0.2
_MAX_SAMPLED_PIXELS = 40_000
#: Height of the panel below which the histogram is hidden, pixels.
_MIN_HEIGHT_FOR_HISTOGRAM = 420


class CameraPanel(Panel):
    """Frames and slopes of the wavefront sensor."""

    name: ClassVar[str] = "camera"
    title: ClassVar[str] = "Sensor camera"
    tab_title: ClassVar[str] = "Sensor"
    help: ClassVar[str] = (
        "Frames of the wavefront sensor, or the slopes computed from them. Saturated pixels are hatched and "
        "counted. 'Set reference' stores the current frame; 'difference' shows later frames minus it."
    )
    streams: ClassVar[tuple[str, ...]] = ("frames", "slopes")
    rate_hz: ClassVar[float] = 30.0
    stale_after_s: ClassVar[float | None] = 1.0
    placeholder: ClassVar[str] = "No frames.\nThey are shown once a server has opened the sensor's camera."

    #: Name of the camera whose settings are to be shown.
    settings_requested = Signal(str)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        theme = context.theme
        self.choice = SegmentedButton("View of the sensor", (RAW, ARROWS, MAPS, DIFFERENCE), _TIPS)
        self.choice.chosen.connect(self._on_view_changed)
        self.set_reference_button = QToolButton()
        self.set_reference_button.setText("Set reference")
        self.set_reference_button.setToolTip("Use the present frame as reference")
        self.set_reference_button.clicked.connect(self._set_reference)
        self.saturation = QLabel()
        self.image_view = ImageViewer(theme, "Frame of the sensor", SEQUENTIAL_MAPS, unit="counts")
        self.signed = ImageViewer(theme, "Slopes or difference", DIVERGING_MAPS, symmetric=True)
        self.quiver = Quiver(theme)
        self.image_view.box.addItem(self.quiver)
        self._outlines = pg.PlotCurveItem()
        self._outlines.setZValue(3)
        self.image_view.box.addItem(self._outlines)
        self.bars = (
            ImageToolbar(theme, self.image_view),
            ImageToolbar(theme, self.signed),
        )
        self.plot_choice = SegmentedButton("Plot of the frame", (HISTOGRAM, SECTION), _PLOT_TIPS)
        self.plot_choice.chosen.connect(self._on_view_changed)
        self.section = SectionPlot(theme, "counts")
        self.image_view.pixel_clicked.connect(self._on_pixel_clicked)
        self.image_view.view.double_clicked.connect(lambda: self._on_pixel_clicked(-1, -1))
        self.histogram = Plot(theme, "Histogram of the frame", "counts", "pixels")
        self.histogram.setLogMode(x=False, y=True)
        self._curve = self.histogram.curve(0, alone=True, stepMode="center")
        self.body.addLayout(row(self.choice, None))
        for widget in (self.saturation, self.image_view, self.signed):
            self.body.addWidget(widget)
        self.settings_button = flat_button(
            "Settings…", "Exposure, gain, region, dark and flat of this camera"
        )
        self.settings_button.clicked.connect(lambda: self.settings_requested.emit("wfs"))
        self.body.addLayout(
            row(self.set_reference_button, self.settings_button, *((bar, 1) for bar in self.bars))
        )
        self.body.addWidget(self.plot_choice)
        self.body.addWidget(self.histogram)
        self.body.addWidget(self.section)
        self.body.setStretchFactor(self.image_view, 1)
        self.body.setStretchFactor(self.signed, 1)
        self._frame: NDArray[Any] | None = None
        self._reference: NDArray[Any] | None = None
        self._slopes: NDArray[Any] | None = None
        self._valid = np.zeros((0, 0), bool)
        self._full_scale: float | None = None
        self._histogram_due = 0.0
        self._update_visibility()
        self.apply_theme()

    # ------------------------------------------------------------ data
    def on_geometry(self) -> None:
        self._valid = mask_from_rows(self.bench_geometry.valid)
        self._outlines.setData(*outline_points(self.bench_geometry.outlines_px), connect="finite")
        self.quiver.set_geometry(self.bench_geometry)

    def on_state(self, state: State) -> None:
        light = state.illumination
        peak, saturated = f"{100 * light.peak:3.0f} %", f"{100 * light.saturated:5.2f} %"
        if not has_frames(state):
            peak = saturated = UNKNOWN_VALUE
        self.saturation.setText(f"peak {peak}   saturated {saturated}")

    def on_sample(self, stream: str, sample: Sample) -> None:
        if stream == "slopes":
            self._slopes = sample.data
            self._show_slopes()
            return
        self._frame = sample.data
        full_scale = sample.meta.get("full_scale")
        self._full_scale = float(full_scale) if full_scale is not None else None
        self._show_frame()

    def _show_frame(self) -> None:
        frame, view = self._frame, self.choice.selected
        if frame is None or view == MAPS:
            return
        if view == DIFFERENCE:
            if self._reference is not None and self._reference.shape == frame.shape:
                self.signed.show_array(frame.astype(np.float32) - self._reference)
            return
        self.image_view.show_array(frame)
        now = time.monotonic()
        if now >= self._histogram_due:
            self._histogram_due = now + _HISTOGRAM_PERIOD_S
            self.image_view.mark_pixels(None if self._full_scale is None else frame >= self._full_scale)
            self._show_plot(frame)

    def _show_plot(self, frame: NDArray[Any]) -> None:
        if not self.section.isHidden():
            shown = frame if self.image_view.data is None else self.image_view.data
            self.image_view.mark_section(self.section.show_image(shown))
        else:
            self.image_view.mark_section(None)
            if not self.histogram.isHidden():
                self._show_histogram(frame)

    def _on_pixel_clicked(self, x: int, y: int) -> None:
        """Put the section through a pixel; -1: through the brightest."""
        self.section.place = (x, y) if x >= 0 else None
        self._histogram_due = 0.0
        self._show_frame()

    def _show_histogram(self, frame: NDArray[Any]) -> None:
        step = max(1, int(np.sqrt(frame.size / _MAX_SAMPLED_PIXELS)))
        sample = frame[::step, ::step]
        top = self._full_scale if self._full_scale is not None else float(sample.max()) + 1
        counts, edges = np.histogram(sample, bins=_BINS, range=(0, max(top, 1.0)))
        self._curve.setData(edges, counts + 0.5)

    def _show_slopes(self) -> None:
        slopes, view = self._slopes, self.choice.selected
        if slopes is None or 2 * int(self._valid.sum()) != slopes.size:
            return
        if view == ARROWS:
            self.quiver.show_slopes(slopes)
        elif view == MAPS:
            self.signed.show_array(slope_map_pair(slopes, self._valid))

    # ------------------------------------------------------------ views
    def resizeEvent(self, event: QResizeEvent) -> None:
        super().resizeEvent(event)
        self._update_visibility()

    def _update_visibility(self) -> None:
        signed = self.choice.selected in (MAPS, DIFFERENCE)
        for widget in (self.image_view, self.bars[0]):
            widget.setVisible(not signed)
        self.set_reference_button.setVisible(self.choice.selected == DIFFERENCE)
        for widget in (self.signed, self.bars[1]):
            widget.setVisible(signed)
        self.quiver.setVisible(self.choice.selected == ARROWS)
        high = self.height() >= self.context.theme.pixels(_MIN_HEIGHT_FOR_HISTOGRAM)
        plotted = self.plot_choice.selected
        self.histogram.setVisible(high and not signed and plotted == HISTOGRAM)
        self.section.setVisible(high and not signed and plotted == SECTION)
        self.plot_choice.setVisible(high and not signed)

    def _on_view_changed(self, _: str) -> None:
        view = self.choice.selected
        self._update_visibility()
        self.signed.clear()
        self._histogram_due = 0.0
        if view == DIFFERENCE and self._reference is None:
            self._set_reference()
        self._show_frame()
        self._show_slopes()

    def _set_reference(self) -> None:
        if self._frame is not None:
            self._reference = self._frame.astype(np.float32)

    def clear(self) -> None:
        self._frame = self._reference = self._slopes = self.section.place = None
        self.image_view.clear()
        self.signed.clear()

    def apply_theme(self) -> None:
        theme = self.context.theme
        self.saturation.setFont(theme.font(0.9, mono=True))
        self.histogram.setFixedHeight(theme.pixels(92))
        self.section.setFixedHeight(theme.pixels(120))
        colour = theme.series(1)
        colour.setAlpha(90)
        self._outlines.setPen(pg.mkPen(colour, width=1))

    def export_arrays(self) -> tuple[ExportArray, ...]:
        arrays = (("frame", self._frame, "count"), ("slopes", self._slopes, "pixel"))
        return tuple(ExportArray(name, data, unit) for name, data, unit in arrays if data is not None)
