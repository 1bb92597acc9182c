"""Deformable mirror: commands, and measured positions if available."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from escape_gui.client.availability import UNKNOWN_VALUE, is_measured
from escape_gui.panels.base import Context, ExportArray, Panel
from escape_gui.views.images import ActuatorImage
from escape_gui.widgets.controls import Readout, SegmentedButton, caption, readout_grid, row
from escape_gui.widgets.images import DIVERGING_MAPS, ImageToolbar, ImageViewer
from escape_hw.remote.source import Sample
from escape_hw.remote.state import State

COMMAND, MEASURED = "command", "measured"


class MirrorPanel(Panel):
    """Map of the actuators."""

    name: ClassVar[str] = "mirror"
    title: ClassVar[str] = "Mirror"
    help: ClassVar[str] = (
        "Command of each actuator as a fraction of its full stroke, at its position on the mirror; measured "
        "positions for adaptive secondaries. Clipped: actuators at a limit, mean of the last second."
    )
    streams: ClassVar[tuple[str, ...]] = ("commands", "measured_positions")
    rate_hz: ClassVar[float] = 20.0
    placeholder: ClassVar[str] = (
        "The mirror is flat and no command was sent yet.\nStart a calibration, or close the loop."
    )

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        theme = context.theme
        self.choice = SegmentedButton(
            "View of the mirror",
            (COMMAND, MEASURED),
            ("Command of each actuator", "Measured positions (adaptive secondaries only)"),
        )
        self.choice.chosen.connect(lambda _: self._update_image())
        self.image_view = ImageViewer(
            theme, "Map of the actuators", DIVERGING_MAPS, symmetric=True, unit="stroke", min_level=1e-6
        )
        self.scale = caption()
        self.readouts = {
            "rms": Readout(theme, "rms", "stroke", 6),
            "peak": Readout(theme, "peak", "stroke", 6),
            "clipped": Readout(theme, "clipped", "%", 6),
        }
        self.body.addLayout(row(self.choice, None, self.scale))
        self.body.addWidget(self.image_view, 1)
        self.body.addWidget(ImageToolbar(theme, self.image_view))
        self.body.addLayout(readout_grid(self.readouts))
        self._values: dict[str, NDArray[Any]] = {}
        self._map = ActuatorImage(self.bench_geometry)
        self._update_measured_button()
        self.apply_theme()

    def on_geometry(self) -> None:
        self._map = ActuatorImage(self.bench_geometry)
        self.image_view.clear()
        self._update_image()

    def on_state(self, state: State) -> None:
        mirror = state.mirror
        values = {
            "rms": f"{mirror.rms:.4f}",
            "peak": f"{mirror.peak:.4f}",
            "clipped": f"{100 * mirror.saturated_share:.2f}",
        }
        for name, text in values.items():
            self.readouts[name].show_value(text if is_measured(state) else UNKNOWN_VALUE)

    def on_sample(self, stream: str, sample: Sample) -> None:
        key = COMMAND if stream == "commands" else MEASURED
        new = key not in self._values
        self._values[key] = sample.data
        if new:
            self._update_measured_button()
        if key == self.choice.selected:
            self._update_image()

    def _update_image(self) -> None:
        values = self._values.get(self.choice.selected)
        if values is None or values.size != self._map.n_act:
            return
        if self.choice.selected == MEASURED:
            self.image_view.unit, values = "µm", values * 1e6
        else:
            self.image_view.unit = "stroke"
        self.image_view.show_array(self._map.to_image(values))
        self.scale.setText(f"±{self.image_view.levels[1]:.3g} {self.image_view.unit}")

    def _update_measured_button(self) -> None:
        button = self.choice.buttons[MEASURED]
        button.setEnabled(MEASURED in self._values)
        button.setVisible(MEASURED in self._values)

    def clear(self) -> None:
        self._values.clear()
        self.image_view.clear()
        self.choice.choose(COMMAND)
        self._update_measured_button()

    def apply_theme(self) -> None:
        self.scale.setFont(self.context.theme.font(0.9, mono=True))

    def export_arrays(self) -> tuple[ExportArray, ...]:
        units = {COMMAND: "stroke", MEASURED: "m"}
        return tuple(ExportArray(key, np.asarray(data), units[key]) for key, data in self._values.items())
