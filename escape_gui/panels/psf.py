"""The science camera's image beside the model it is measured against."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from PySide6.QtWidgets import QHBoxLayout, QLabel, QVBoxLayout

from escape_gui.panels.base import Context, ExportArray, Panel
from escape_gui.views.images import RadialProfile
from escape_gui.widgets.images.image_viewer import ImageToolbar, ImageViewer
from escape_gui.widgets.plots.plot import Plot
from escape_hw.remote.source import Sample

#: The lowest value of the profiles, relative to the peak of the model.
_FLOOR = 1e-4

CAPTIONS = {"psf": "measured, solid", "model_psf": "model, dashed"}
#: Instead of the model while there is none, and why that matters.
NO_MODEL = "no model image yet: run model-psf"
NO_MODEL_TIP = "The Strehl ratio is the image's peak against the model's; 'Model PSF' measures it"


class PsfPanel(Panel):
    """Image, model and the radial profiles of both."""

    name: ClassVar[str] = "psf"
    title: ClassVar[str] = "Image"
    help: ClassVar[str] = (
        "The science camera's image and the model of a perfect one on a logarithmic scale of four decades, "
        "and the mean of each over rings about its peak. Both profiles have the same total light and are "
        "relative to the model's peak, so that the first point is about the Strehl ratio."
    )
    streams: ClassVar[tuple[str, ...]] = ("psf", "model_psf")
    rate_hz: ClassVar[float] = 10.0
    placeholder: ClassVar[str] = (
        "No image yet.\nThe science camera is read while the loop is closed, or it does not exist here."
    )

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        theme = context.theme
        self.pictures = {
            "psf": ImageViewer(theme, "Image of the science camera", unit="counts"),
            "model_psf": ImageViewer(theme, "Model of a perfect image"),
        }
        self.captions: dict[str, QLabel] = {}
        pair = QHBoxLayout()
        pair.setSpacing(8)
        for key, caption in CAPTIONS.items():
            self.pictures[key].logarithmic = True
            self.pictures[key].set_colour_map(1)
            column = QVBoxLayout()
            column.setSpacing(2)
            label = QLabel(caption)
            label.setObjectName("caption")
            self.captions[key] = label
            column.addWidget(label)
            column.addWidget(self.pictures[key], 1)
            pair.addLayout(column, 1)
        self.plot = Plot(theme, "Radial profiles", "radius [pixel]", "relative")
        self.plot.setLogMode(x=False, y=True)
        self.plot.setYRange(np.log10(_FLOOR), 0.1)
        self.plot.setXRange(0, 40)
        self.plot.pin_left_axis()
        self._curves = {
            "psf": self.plot.curve(0, name="measured"),
            "model_psf": self.plot.curve(1, name="model"),
        }
        self.plot.setMinimumHeight(120)
        self.body.addLayout(pair, 3)
        self.body.addWidget(ImageToolbar(theme, self.pictures["psf"]))
        self.body.addWidget(self.plot, 2)
        self._images: dict[str, NDArray[Any]] = {}
        self._profiles: dict[str, NDArray[np.float64]] = {}
        self._radial = RadialProfile((1, 1), (0, 0))
        self._update_model_caption()

    def on_sample(self, stream: str, sample: Sample) -> None:
        self._images[stream] = sample.data
        self._update_model_caption()
        self.pictures[stream].show_array(sample.data)
        self._profiles[stream] = self._profile(sample.data)
        model = self._profiles.get("model_psf")
        measured = self._profiles.get("psf")
        reference = model if model is not None else measured
        if reference is None or reference.size == 0 or not reference[0] > 0:
            return
        for key, profile in self._profiles.items():
            relative = np.maximum(profile / reference[0], _FLOOR)
            self._curves[key].setData(np.arange(relative.size), relative)

    def _update_model_caption(self) -> None:
        label = self.captions["model_psf"]
        label.setText(CAPTIONS["model_psf"] if "model_psf" in self._images else NO_MODEL)
        label.setToolTip(NO_MODEL_TIP if "model_psf" not in self._images else "")

    def _profile(self, image: NDArray[Any]) -> NDArray[np.float64]:
        """Mean over rings, of the light above the darkest corner, as a share of all of it."""
        peak = np.unravel_index(int(np.argmax(image)), image.shape)
        centre = (int(peak[0]), int(peak[1]))
        if (self._radial.shape, self._radial.centre) != (image.shape, centre):
            self._radial = RadialProfile(image.shape, centre)
        light = image - float(np.median(image))
        total = float(light.sum())
        return self._radial(light) / total if total > 0 else np.zeros(0)

    def clear(self) -> None:
        self._images.clear()
        self._profiles.clear()
        self._update_model_caption()
        for key, picture in self.pictures.items():
            picture.clear()
            self._curves[key].setData([], [])

    def export_arrays(self) -> tuple[ExportArray, ...]:
        images = [ExportArray(key, data, "count") for key, data in self._images.items()]
        profiles = [
            ExportArray(f"{key}_profile", data, "share per pixel") for key, data in self._profiles.items()
        ]
        return (*images, *profiles)
