"""Image of the science camera beside the reference PSF."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from PySide6.QtWidgets import QHBoxLayout, QLabel

from escape_gui.panels.base import Context, ExportArray, Panel
from escape_gui.views.images import RadialProfile
from escape_gui.widgets.controls import caption, column
from escape_gui.widgets.images import ImageToolbar, ImageViewer
from escape_gui.widgets.plots import Plot
from escape_hw.remote.source import Sample

#: Lower limit of the profiles, relative to the peak of the reference.
_MIN_PROFILE = 1e-4
CAPTIONS = {"psf": "PSF: measured (—)", "model_psf": "PSF: reference (- -)"}
#: Caption and tooltip if there is no reference.
NO_REFERENCE = "no reference PSF"
NO_REFERENCE_TIP = "The Strehl ratio is relative to the peak of the reference PSF; 'Model PSF' measures it"


class PsfPanel(Panel):
    """Measured and reference PSF, and their radial profiles."""

    name: ClassVar[str] = "psf"
    title: ClassVar[str] = "PSF"
    help: ClassVar[str] = (
        "Image of the science camera and reference PSF on a logarithmic scale of four decades, and their "
        "radial profiles about the peak. Both profiles are normalised to the same total flux and to the peak "
        "of the reference, so that the measured profile starts at about the Strehl ratio."
    )
    streams: ClassVar[tuple[str, ...]] = ("psf", "model_psf")
    rate_hz: ClassVar[float] = 10.0
    placeholder: ClassVar[str] = (
        "No image yet.\nThe science camera, if there is one, is read while the loop is closed."
    )

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
            image_view.logarithmic = True
            image_view.set_colour_map(1)
            pair.addLayout(column(self.captions[key], (image_view, 1), spacing=2), 1)
        self.plot = Plot(theme, "Radial profiles", "radius [pixel]", "relative")
        self.plot.setLogMode(x=False, y=True)
        self.plot.setYRange(np.log10(_MIN_PROFILE), 0.1)
        self.plot.setXRange(0, 40)
        self.plot.pin_left_axis()
        self._curves = {
            "psf": self.plot.curve(0, name="measured"),
            "model_psf": self.plot.curve(1, name="reference"),
        }
        self.plot.setMinimumHeight(120)
        self.body.addLayout(pair, 3)
        self.body.addWidget(ImageToolbar(theme, self.image_views["psf"]))
        self.body.addWidget(self.plot, 2)
        self._images: dict[str, NDArray[Any]] = {}
        self._profiles: dict[str, NDArray[np.float64]] = {}
        self._radial = RadialProfile((1, 1), (0, 0))
        self._update_reference_caption()

    def on_sample(self, stream: str, sample: Sample) -> None:
        self._images[stream] = sample.data
        self._update_reference_caption()
        self.image_views[stream].show_array(sample.data)
        self._profiles[stream] = self._profile(sample.data)
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

    def export_arrays(self) -> tuple[ExportArray, ...]:
        images = [ExportArray(key, data, "count") for key, data in self._images.items()]
        profiles = [
            ExportArray(f"{key}_profile", data, "share per pixel") for key, data in self._profiles.items()
        ]
        return (*images, *profiles)
