"""Image of the science camera beside the reference PSF."""

from __future__ import annotations

import time
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from PySide6.QtCore import Signal
from PySide6.QtGui import QResizeEvent
from PySide6.QtWidgets import QHBoxLayout, QLabel, QSizePolicy

from escape_gui.client.availability import UNKNOWN_VALUE
from escape_gui.panels.base import Context, ExportArray, Panel
from escape_gui.views.images import RadialProfile
from escape_gui.widgets.controls import SegmentedButton, caption, column, flat_button, row
from escape_gui.widgets.images import ImageToolbar, ImageViewer
from escape_gui.widgets.plots import Plot, SectionPlot
from escape_hw.errors import CalibrationError
from escape_hw.pipeline.psf.shape import PsfShape, encircled_energy, measure_psf_shape
from escape_hw.pipeline.psf.strehl import subtract_background
from escape_hw.remote.source import Sample

#: Lower limit of the profiles, relative to the peak of the reference.
_MIN_PROFILE = 1e-4
PROFILE, SECTION, ENERGY = "profile", "section", "energy"
_TIPS = (
    "Radial profiles about the peak",
    "Row and column through the pixel that was clicked, at first the brightest; a double click returns to it",
    "Share of the light within a radius about the peak",
)
#: Period of the measurement of width and encircled energy, which takes about 20 ms.
_SHAPE_PERIOD_S = 1.0
CAPTIONS = {"psf": "PSF: measured (—)", "model_psf": "PSF: reference (- -)"}
#: Caption and tooltip if there is no reference.
NO_REFERENCE = "no reference PSF"
NO_REFERENCE_TIP = "The Strehl ratio is relative to the peak of the reference PSF; 'Model PSF' measures it"


class PsfPanel(Panel):
    """Measured and reference PSF, and their radial profiles."""

    name: ClassVar[str] = "psf"
    title: ClassVar[str] = "PSF"
    help: ClassVar[str] = (
        "Image of the science camera and reference PSF, their radial profiles, cross-sections through a "
        "clicked pixel, and encircled energy. Both profiles are normalised to the same total flux and to the "
        "peak of the reference, so that the measured profile starts at about the Strehl ratio. The line "
        "below gives the full width at half maximum and the radii of 50 % and 80 % of the light."
    )
    streams: ClassVar[tuple[str, ...]] = ("psf", "model_psf")
    rate_hz: ClassVar[float] = 10.0
    placeholder: ClassVar[str] = (
        "No image.\nIt is shown when a server has opened the science camera, if there is one."
    )

    #: Name of the camera whose settings are to be shown.
    settings_requested = Signal(str)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        theme = context.theme
        self.image_views = {
            "psf": ImageViewer(theme, "Image of the science camera", unit="counts"),
            "model_psf": ImageViewer(theme, "Reference PSF"),
        }
        self.captions: dict[str, QLabel] = {key: caption(text) for key, text in CAPTIONS.items()}
        pair = QHBoxLayout()
        pair.setSpacing(8)
        for key, image_view in self.image_views.items():
            image_view.set_stretch("log")
            image_view.set_colour_map(1)
            pair.addLayout(column(self.captions[key], (image_view, 1), spacing=2), 1)
        measured = self.image_views["psf"]
        measured.pixel_clicked.connect(self._on_pixel_clicked)
        measured.view.double_clicked.connect(lambda: self._on_pixel_clicked(-1, -1))
        self.toolbar = ImageToolbar(theme, measured, linked=(self.image_views["model_psf"],))
        self.choice = SegmentedButton("Plot of the PSF", (PROFILE, SECTION, ENERGY), _TIPS)
        self.choice.chosen.connect(self._on_plot_chosen)
        #: Width and encircled energy of the measured image.
        self.shape_text = QLabel()
        for label in (self.shape_text, *self.captions.values()):
            # The text must not widen the panel.
            label.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Fixed)
        self.shape: PsfShape | None = None
        self._shape_due = 0.0
        self._make_plots()
        self.body.setSpacing(4)
        self.body.addLayout(pair, 3)
        self.settings_button = flat_button("Settings…", "Exposure, gain and region of the science camera")
        self.settings_button.clicked.connect(lambda: self.settings_requested.emit("science"))
        self.body.addWidget(self.toolbar)
        self.body.addLayout(row(self.choice, None, self.settings_button, spacing=2))
        for plot in self.plots.values():
            self.body.addWidget(plot, 2)
        self.body.addWidget(self.shape_text)
        self._show_plot()
        self._images: dict[str, NDArray[Any]] = {}
        self._profiles: dict[str, NDArray[np.float64]] = {}
        self._radial = RadialProfile((1, 1), (0, 0))
        self._update_reference_caption()
        self.apply_theme()

    def _make_plots(self) -> None:
        theme = self.context.theme
        profile = Plot(theme, "Radial profiles", "radius [pixel]", "relative")
        profile.setLogMode(x=False, y=True)
        profile.setYRange(np.log10(_MIN_PROFILE), 0.1)
        profile.setXRange(0, 40)
        self._curves = {
            "psf": profile.curve(0, name="measured"),
            "model_psf": profile.curve(1, name="reference"),
        }
        energy = Plot(theme, "Encircled energy", "radius [pixel]", "share")
        energy.setYRange(0, 1)
        energy.setXRange(0, 40)
        self._energy_curves = {key: energy.curve(k) for k, key in enumerate(self._curves)}
        self.section = SectionPlot(theme, "counts")
        self.plots: dict[str, Plot] = {PROFILE: profile, SECTION: self.section, ENERGY: energy}
        for plot in self.plots.values():
            plot.pin_left_axis()
            plot.setMinimumHeight(84)

    # ------------------------------------------------------------ plots
    def _show_plot(self) -> None:
        for name, plot in self.plots.items():
            plot.setVisible(name == self.choice.selected)

    def _on_plot_chosen(self, _: str) -> None:
        self._show_plot()
        self._shape_due = 0.0
        self._show_section()
        self._measure_shape()

    def _on_pixel_clicked(self, x: int, y: int) -> None:
        """Put the section through a pixel; -1: through the brightest."""
        self.section.place = (x, y) if x >= 0 else None
        self._show_section()

    def _show_section(self) -> None:
        view = self.image_views["psf"]
        if view.data is None or self.choice.selected != SECTION:
            view.mark_section(None)
            return
        view.mark_section(self.section.show_image(view.data))

    def _measure_shape(self) -> None:
        """Measure width and encircled energy, at most once a second."""
        image, now = self.image_views["psf"].data, time.monotonic()
        if image is None or now < self._shape_due:
            return
        self._shape_due = now + _SHAPE_PERIOD_S
        try:
            self.shape = measure_psf_shape(image)
        except CalibrationError as error:
            self.shape = None
            self.shape_text.setText(f"no width: {error}")
            return
        self._show_shape()
        if self.choice.selected != ENERGY:
            return
        for key, view in self.image_views.items():
            if view.data is not None:
                clean = subtract_background(view.data)
                peak = np.unravel_index(int(np.argmax(clean)), clean.shape)
                self._energy_curves[key].setData(*encircled_energy(clean, (float(peak[0]), float(peak[1]))))

    def _show_shape(self) -> None:
        """Show the numbers of the shape; in a narrow panel only the widths."""
        if self.shape is None:
            return
        text = format_shape(self.shape, self.bench_geometry.psf_px)
        metrics, margins = self.shape_text.fontMetrics(), self.body.contentsMargins()
        room = self.width() - margins.left() - margins.right()
        fits = max(map(metrics.horizontalAdvance, text.splitlines())) <= room
        self.shape_text.setText(text if fits else format_widths(self.shape))
        self.shape_text.setToolTip(text)

    def resizeEvent(self, event: QResizeEvent) -> None:
        super().resizeEvent(event)
        self._show_shape()

    def on_geometry(self) -> None:
        # lambda/D is known now.
        self._shape_due, self.dirty = 0.0, True

    def redraw(self) -> None:
        self._measure_shape()

    def on_sample(self, stream: str, sample: Sample) -> None:
        self._images[stream] = sample.data
        self._update_reference_caption()
        view = self.image_views[stream]
        view.show_array(sample.data)
        self._profiles[stream] = self._profile(sample.data if view.data is None else view.data)
        if stream == "psf":
            full_scale = sample.meta.get("full_scale")
            view.mark_pixels(None if full_scale is None else sample.data >= float(full_scale))
            self._show_section()
            self._measure_shape()
        reference = self._profiles.get("model_psf", self._profiles.get("psf"))
        if reference is None or reference.size == 0 or not reference[0] > 0:
            return
        for key, profile in self._profiles.items():
            relative = np.maximum(profile / reference[0], _MIN_PROFILE)
            self._curves[key].setData(np.arange(relative.size), relative)

    def _update_reference_caption(self) -> None:
        label, known = self.captions["model_psf"], "model_psf" in self._images
        label.setText(CAPTIONS["model_psf"] if known else NO_REFERENCE)
        label.setToolTip("" if known else NO_REFERENCE_TIP)

    def _profile(self, image: NDArray[Any]) -> NDArray[np.float64]:
        """Radial profile of the image minus its median, as a fraction of the total flux per pixel."""
        peak = np.unravel_index(int(np.argmax(image)), image.shape)
        centre = (int(peak[0]), int(peak[1]))
        if (self._radial.shape, self._radial.centre) != (image.shape, centre):
            self._radial = RadialProfile(image.shape, centre)
        flux = image - float(np.median(image))
        total = float(flux.sum())
        return self._radial(flux) / total if total > 0 else np.zeros(0)

    def clear(self) -> None:
        self._images.clear()
        self._profiles.clear()
        self._update_reference_caption()
        for key, image_view in self.image_views.items():
            image_view.clear()
            self._curves[key].setData([], [])
            self._energy_curves[key].setData([], [])
        self.section.place = self.shape = None
        self.shape_text.clear()

    def apply_theme(self) -> None:
        self.shape_text.setFont(self.context.theme.font(0.9, mono=True))

    def export_arrays(self) -> tuple[ExportArray, ...]:
        images = [ExportArray(key, data, "count") for key, data in self._images.items()]
        profiles = [
            ExportArray(f"{key}_profile", data, "share per pixel") for key, data in self._profiles.items()
        ]
        return (*images, *profiles)


def format_widths(shape: PsfShape) -> str:
    """Width and radii of encircled energy in pixels, in one short line."""
    return (
        f"FWHM {_number(shape.fwhm, 2)} px, 50 % {_number(shape.r50, 1)} px, 80 % {_number(shape.r80, 1)} px"
    )


def _number(value: float, decimals: int) -> str:
    """A number; that of a radius beyond the image is unknown."""
    return f"{value:.{decimals}f}" if np.isfinite(value) else UNKNOWN_VALUE


def format_shape(shape: PsfShape, psf_px: float) -> str:
    """Width and encircled energy in pixels and, where lambda/D is known, in lambda/D."""

    def length(pixels: float) -> str:
        known = psf_px and np.isfinite(pixels)
        return f"{_number(pixels, 2)} px" + (f" ({pixels / psf_px:.2f} λ/D)" if known else "")

    axes = f"{_number(shape.major, 2)} × {_number(shape.minor, 2)}"
    elongation = f"{axes} at {_number(shape.angle_deg, 0)}°"
    return (
        f"FWHM {length(shape.fwhm)}, {elongation}   peak {shape.peak:.0f}\n"
        f"50 % within {length(shape.r50)}   80 % within {length(shape.r80)}"
    )
