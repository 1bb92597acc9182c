"""The deformable mirror: what it was told, and where it says it is."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from PySide6.QtWidgets import QGridLayout, QHBoxLayout, QLabel

from escape_gui.client.availability import UNKNOWN_VALUE, is_measured
from escape_gui.panels.base import Context, ExportArray, Panel
from escape_gui.views.images import ActuatorImage
from escape_gui.widgets.controls.readout import Readout
from escape_gui.widgets.controls.segmented_button import SegmentedButton
from escape_gui.widgets.images.image_viewer import DIVERGING_MAPS, ImageToolbar, ImageViewer
from escape_hw.remote.source import DataSource, Sample
from escape_hw.remote.state import Geometry, State

COMMAND, MEASURED = "command", "measured"


class MirrorPanel(Panel):
    """Actuators at their places."""

    name: ClassVar[str] = "mirror"
    title: ClassVar[str] = "Mirror"
    help: ClassVar[str] = (
        "What each actuator was told, as a share of its full stroke, at its place on the mirror. An "
        "adaptive secondary also says where it is. Clipped: actuators held at a limit, mean of the last "
        "second."
    )
    streams: ClassVar[tuple[str, ...]] = ("commands", "measured_positions")
    rate_hz: ClassVar[float] = 20.0
    stale_after_s: ClassVar[float | None] = None
    placeholder: ClassVar[str] = (
        "The mirror is flat and nothing was sent yet.\nStart a calibration, or close the loop."
    )

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        theme = context.theme
        self.choice = SegmentedButton(
            "View of the mirror",
            (COMMAND, MEASURED),
            ("What the actuators were told", "Where they say they are (adaptive secondaries only)"),
        )
        self.choice.chosen.connect(lambda _: self._update_image())
        self.picture = ImageViewer(
            theme, "Map of the actuators", DIVERGING_MAPS, symmetric=True, unit="stroke"
        )
        self.picture.floor = 1e-6
        self.scale = QLabel()
        self.scale.setObjectName("caption")
        head = QHBoxLayout()
        head.addWidget(self.choice)
        head.addStretch()
        head.addWidget(self.scale)
        self.readouts = {
            "rms": Readout(theme, "rms", "stroke", 6),
            "peak": Readout(theme, "peak", "stroke", 6),
            "clipped": Readout(theme, "clipped", "%", 6),
        }
        numbers = QGridLayout()
        numbers.setHorizontalSpacing(24)
        numbers.setVerticalSpacing(2)
        for k, readout in enumerate(self.readouts.values()):
            numbers.addWidget(readout, k // 2, k % 2)
        numbers.setColumnStretch(2, 1)
        self.body.addLayout(head)
        self.body.addWidget(self.picture, 1)
        self.body.addWidget(ImageToolbar(theme, self.picture, logarithmic=False))
        self.body.addLayout(numbers)
        self._values: dict[str, NDArray[Any]] = {}
        self._geometry = Geometry()
        self._map = ActuatorImage(self._geometry)
        self._update_measured_button()
        self.apply_theme()

    def tick(self, source: DataSource) -> None:
        """Places come with the geometry."""
        geometry = source.geometry()
        if geometry is not self._geometry:
            self._geometry = geometry
            self._map = ActuatorImage(geometry)
            self.picture.clear()
            self._update_image()

    def on_state(self, state: State) -> None:
        """Numbers that the server takes over every frame."""
        mirror = state.mirror
        values = {
            "rms": f"{mirror.rms:.4f}",
            "peak": f"{mirror.peak:.4f}",
            "clipped": f"{100 * mirror.saturated_share:.2f}",
        }
        for name, text in values.items():
            self.readouts[name].show_value(text if is_measured(state) else UNKNOWN_VALUE)

    def on_sample(self, stream: str, sample: Sample) -> None:
        """Another command, or where the actuators are."""
        key = COMMAND if stream == "commands" else MEASURED
        new = key not in self._values
        self._values[key] = sample.data
        if new:
            self._update_measured_button()
        if key == self.choice.word:
            self._update_image()

    def _update_image(self) -> None:
        values = self._values.get(self.choice.word)
        if values is None or values.size != self._map.n_act:
            return
        if self.choice.word == MEASURED:
            self.picture.unit, values = "µm", values * 1e6
        else:
            self.picture.unit = "stroke"
        self.picture.show_array(self._map.picture(values))
        high = self.picture.levels[1]
        self.scale.setText(f"±{high:.3g} {self.picture.unit}")

    def _update_measured_button(self) -> None:
        button = self.choice.buttons[MEASURED]
        button.setEnabled(MEASURED in self._values)
        button.setVisible(MEASURED in self._values)

    def clear(self) -> None:
        """Another source has another mirror."""
        self._values.clear()
        self._geometry = Geometry()
        self._map = ActuatorImage(self._geometry)
        self.choice.choose(COMMAND)
        self._update_measured_button()
        self.picture.clear()

    def apply_theme(self) -> None:
        """Numbers stand in columns."""
        self.scale.setFont(self.context.theme.font(0.9, mono=True))

    def export_arrays(self) -> tuple[ExportArray, ...]:
        """Command and positions as last seen."""
        units = {COMMAND: "stroke", MEASURED: "m"}
        return tuple(ExportArray(key, np.asarray(data), units[key]) for key, data in self._values.items())
