"""The wavefront sensor's camera: frames, slopes, where the light is too much."""

from __future__ import annotations

import time
from typing import Any, ClassVar

import numpy as np
import pyqtgraph as pg
from numpy.typing import NDArray
from PySide6.QtGui import QResizeEvent
from PySide6.QtWidgets import QHBoxLayout, QLabel, QToolButton

from escape_gui.maps import mask_of, slope_maps
from escape_gui.panels.panel import Context, Panel, Shown
from escape_gui.situation import UNKNOWN, is_lit
from escape_gui.widgets.choice import Choice
from escape_gui.widgets.picture import COUNTS, SIGNED, Picture
from escape_gui.widgets.picture_bar import PictureBar
from escape_gui.widgets.plot import Plot
from escape_gui.widgets.quiver import Quiver, outline_points
from escape_hw.remote.source import Sample, Source
from escape_hw.remote.state import Geometry, State

RAW, ARROWS, MAPS, CHANGE = "raw", "arrows", "x | y", "change"
_TIPS = (
    "The frame as it comes",
    "Slopes as arrows over the frame",
    "Slopes in x and in y as maps",
    "The frame minus the one that was kept",
)
_BINS = 128
_HISTOGRAM_EVERY_S = 0.2
_SAMPLED = 40_000
#: Pixels of height below which the histogram gives way.
_LEAST_HEIGHT = 420


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
    empty: ClassVar[str] = "No frames yet.\nThey come as soon as a server has opened the sensor's camera."

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        theme = context.theme
        self.choice = Choice("View of the sensor", (RAW, ARROWS, MAPS, CHANGE), _TIPS)
        self.choice.chosen.connect(self._change_view)
        self.keep_button = QToolButton()
        self.keep_button.setText("Keep")
        self.keep_button.setToolTip("Keep this frame; 'change' shows later ones minus this")
        self.keep_button.clicked.connect(self._keep)
        self.saturation = QLabel()
        head = QHBoxLayout()
        head.addWidget(self.choice)
        head.addWidget(self.keep_button)
        head.addStretch()
        self.picture = Picture(theme, "Frame of the sensor", COUNTS, unit="counts")
        self.signed = Picture(theme, "Slopes or difference", SIGNED, symmetric=True)
        self.quiver = Quiver(theme)
        self.picture.box.addItem(self.quiver)
        self._outlines = pg.PlotCurveItem()
        self._outlines.setZValue(3)
        self.picture.box.addItem(self._outlines)
        self.bars = (PictureBar(theme, self.picture), PictureBar(theme, self.signed, logarithmic=False))
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
        self._kept: NDArray[Any] | None = None
        self._slopes: NDArray[Any] | None = None
        self._geometry = Geometry()
        self._valid = np.zeros((0, 0), bool)
        self._top: float | None = None
        self._histogram_due = 0.0
        self._show_parts()
        self.restyle()

    # ------------------------------------------------------------ news
    def tick(self, source: Source) -> None:
        """Outlines appear when the sensor was found."""
        geometry = source.geometry()
        if geometry is not self._geometry:
            self._geometry = geometry
            self._valid = mask_of(geometry.valid)
            self._outlines.setData(*outline_points(geometry.outlines_px), connect="finite")
            self.quiver.place(geometry)

    def take_state(self, state: State) -> None:
        """Saturation, counted by the server over all frames."""
        light = state.light
        peak, saturated = f"{100 * light.peak:3.0f} %", f"{100 * light.saturated:5.2f} %"
        if not is_lit(state):
            peak = saturated = UNKNOWN
        self.saturation.setText(f"peak {peak}   saturated {saturated}")

    def take_sample(self, stream: str, sample: Sample) -> None:
        """A frame or slopes."""
        if stream == "slopes":
            self._slopes = sample.data
            self._show_slopes()
            return
        self._frame = sample.data
        top = sample.meta.get("top")
        self._top = float(top) if top is not None else None
        self._show_frame()

    def _show_frame(self) -> None:
        frame, view = self._frame, self.choice.word
        if frame is None or view == MAPS:
            return
        if view == CHANGE:
            if self._kept is not None and self._kept.shape == frame.shape:
                self.signed.show_array(frame.astype(np.float32) - self._kept)
            return
        self.picture.show_array(frame)
        now = time.monotonic()
        if now >= self._histogram_due:
            self._histogram_due = now + _HISTOGRAM_EVERY_S
            self.picture.show_veil(None if self._top is None else frame >= self._top)
            self._show_histogram(frame)

    def _show_histogram(self, frame: NDArray[Any]) -> None:
        step = max(1, int(np.sqrt(frame.size / _SAMPLED)))
        sample = frame[::step, ::step]
        top = self._top if self._top is not None else float(sample.max()) + 1
        counts, edges = np.histogram(sample, bins=_BINS, range=(0, max(top, 1.0)))
        self._curve.setData(edges, counts + 0.5)

    def _show_slopes(self) -> None:
        slopes, view = self._slopes, self.choice.word
        if slopes is None or 2 * int(self._valid.sum()) != slopes.size:
            return
        if view == ARROWS:
            self.quiver.show_slopes(slopes)
        elif view == MAPS:
            self.signed.show_array(slope_maps(slopes, self._valid))

    # ------------------------------------------------------------ views
    def resizeEvent(self, event: QResizeEvent) -> None:
        """Little room belongs to the picture alone."""
        super().resizeEvent(event)
        self._show_parts()

    def _show_parts(self) -> None:
        signed = self.choice.word in (MAPS, CHANGE)
        for widget in (self.picture, self.bars[0]):
            widget.setVisible(not signed)
        for widget in (self.signed, self.bars[1]):
            widget.setVisible(signed)
        self.quiver.setVisible(self.choice.word == ARROWS)
        room = self.height() >= self.context.theme.pixels(_LEAST_HEIGHT)
        self.histogram.setVisible(room and not signed)

    def _change_view(self, view: str) -> None:
        self._show_parts()
        self.signed.clear()
        if view == CHANGE and self._kept is None:
            self._keep()
        self._show_frame()
        self._show_slopes()

    def _keep(self) -> None:
        if self._frame is not None:
            self._kept = self._frame.astype(np.float32)

    def clear(self) -> None:
        """Another source: nothing kept is comparable."""
        self._frame = self._kept = self._slopes = None
        self._geometry = Geometry()
        self._valid = np.zeros((0, 0), bool)
        self._outlines.setData([], [])
        self.quiver.place(self._geometry)
        self.picture.clear()
        self.signed.clear()

    def restyle(self) -> None:
        """Colours of what lies over the picture."""
        theme = self.context.theme
        self.saturation.setFont(theme.font(0.9, mono=True))
        self.histogram.setFixedHeight(theme.pixels(92))
        colour = theme.series(1)
        colour.setAlpha(90)
        self._outlines.setPen(pg.mkPen(colour, width=1))

    def shown(self) -> tuple[Shown, ...]:
        """Frame and slopes as last seen."""
        parts = []
        if self._frame is not None:
            parts.append(Shown("frame", self._frame, "count"))
        if self._slopes is not None:
            parts.append(Shown("slopes", self._slopes, "pixel"))
        return tuple(parts)
