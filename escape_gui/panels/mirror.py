"""Deformable mirror: commands, measured positions if available, and pokes of single actuators and modes."""

from __future__ import annotations

import time
from typing import Any, ClassVar

import numpy as np
import pyqtgraph as pg
from numpy.typing import NDArray
from PySide6.QtCore import Signal
from PySide6.QtGui import QResizeEvent
from PySide6.QtWidgets import QPushButton, QWidget

from escape_gui.client.availability import (
    UNKNOWN_VALUE,
    RequestContext,
    is_measured,
    reason_no_start,
)
from escape_gui.panels.base import Context, ExportArray, Panel
from escape_gui.views.images import ActuatorImage
from escape_gui.widgets.controls import (
    HoldButton,
    Readout,
    SegmentedButton,
    caption,
    column,
    fit_height,
    flat_button,
    readout_grid,
    row,
    set_available,
    text_label,
)
from escape_gui.widgets.images import DIVERGING_MAPS, ImageToolbar, ImageViewer
from escape_gui.widgets.inputs import NumberBox
from escape_hw.remote.requests import LONGEST_POKE_S
from escape_hw.remote.source import DataSource, Sample
from escape_hw.remote.state import Phase, PokePlan, State

COMMAND, MEASURED = "command", "measured"
ACTUATOR, MODE = "actuator", "mode"
#: Number of the first of each, as in the configuration and in offsets.
_FIRST = {ACTUATOR: 0, MODE: 1}
#: Time without a poke or an edit after which pokes are disarmed, seconds.
ARMED_S = 120.0
#: Largest command, fraction of full stroke, of a mirror that is shown as flat.
_FLAT_LEVEL = 1e-6
#: Height below which the row above the map gives way to the controls of a poke, pixels at font scale 1.
_LOW_PX = 280
_POKE_TIP = "Poke it for the time given; the mirror returns to flat by itself."


def reason_no_poke(now: RequestContext) -> str:
    """Why nothing can be poked."""
    if reason := reason_no_start(now):
        return reason
    state = now.state
    if state.loop.closed:
        return "the loop is closed; open it first"
    if state.active_run is not None:
        return "a poke is held" if state.active_run.name == "poke" else "a procedure is running"
    return "" if state.phase is Phase.IDLE else "the bench is not idle"


class MirrorPanel(Panel):
    """Map of the actuators."""

    name: ClassVar[str] = "mirror"
    title: ClassVar[str] = "Mirror"
    help: ClassVar[str] = (
        "Command of each actuator as a fraction of its full stroke and in nanometres of surface, at its "
        "position on the mirror; measured positions for adaptive secondaries. Clipped: actuators at a limit, "
        "mean of the last second. 'Arm pokes' lets you poke a clicked actuator or a mode."
    )
    streams: ClassVar[tuple[str, ...]] = ("commands", "measured_positions")
    rate_hz: ClassVar[float] = 20.0
    placeholder: ClassVar[str] = (
        "The mirror is flat and no command was sent yet.\nStart a calibration, or close the loop."
    )

    #: The offsets are to be shown.
    offsets_requested = Signal()

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
            theme,
            "Map of the actuators",
            DIVERGING_MAPS,
            symmetric=True,
            unit="stroke",
            min_level=_FLAT_LEVEL,
        )
        self.scale = caption()
        self.readouts = {
            "rms": Readout(theme, "rms", "stroke", 6),
            "rms_nm": Readout(theme, "=", "nm", 6),
            "peak": Readout(theme, "peak", "stroke", 6),
            "peak_nm": Readout(theme, "=", "nm", 6),
            "clipped": Readout(theme, "clipped", "%", 6),
        }
        self._nm_per_stroke, self._state = 0.0, State()
        self.body.setSpacing(4)
        self.offsets_button = flat_button("Offsets…", "Tip, tilt, focus, reference slopes and flat")
        self.offsets_button.clicked.connect(self.offsets_requested)
        # A low panel still has room for the controls of a poke.
        self.image_view.setMinimumHeight(72)
        self._head = QWidget()
        self.body.addWidget(self._head)
        row(self.choice, self.offsets_button, None, self.scale, parent=self._head)
        self.body.addWidget(self.image_view, 1)
        self.arm_button = QPushButton("Arm pokes")
        self._toolbar = ImageToolbar(theme, self.image_view)
        self._poke_target = QWidget()
        self.body.addLayout(row(self.arm_button, (self._toolbar, 1), (self._poke_target, 1)))
        self._numbers = QWidget()
        self._numbers.setLayout(readout_grid(self.readouts))
        self.body.addWidget(self._numbers)
        self._make_poke_controls()
        self._values: dict[str, NDArray[Any]] = {}
        self._map = ActuatorImage(self.bench_geometry)
        self._update_measured_button()
        self.apply_theme()

    # ------------------------------------------------------------ pokes
    def _make_poke_controls(self) -> None:
        """The second step of a poke: choose, see the plan, hold the button."""
        theme = self.context.theme
        self.arm_button.setCheckable(True)
        self.arm_button.toggled.connect(self._on_armed)
        self.poke_kind = SegmentedButton(
            "Poke of", (ACTUATOR, MODE), ("Click an actuator in the map", "Click a mode in 'Mode maps'")
        )
        self.poke_kind.chosen.connect(self._on_kind)
        self.poke_number = NumberBox(0, 100_000, step=1, decimals=0)
        self.poke_amplitude = NumberBox(-1, 1, step=0.01, decimals=3)
        self.poke_amplitude.setValue(0.05)
        self.poke_seconds = NumberBox(0.1, LONGEST_POKE_S, step=1, decimals=1)
        self.poke_seconds.setValue(2.0)
        for box, name in (
            (self.poke_number, "Number of the actuator (from 0) or mode (from 1)"),
            (self.poke_amplitude, "Amplitude, fraction of full stroke"),
            (self.poke_seconds, "Duration in seconds"),
        ):
            box.setAccessibleName(name)
            box.setToolTip(name)
            box.edited.connect(self._on_poke_edit)
        self.poke_text = text_label()
        self.poke_button = HoldButton("poke", theme)
        self.poke_button.confirmed.connect(self._poke)
        self._poke_row = QWidget()
        row(self.poke_kind, (self.poke_number, 1), parent=self._poke_target, spacing=4)
        self._poke_target.hide()
        amount = row(
            (self.poke_amplitude, 1), caption("of the stroke, for"), (self.poke_seconds, 1), caption("s"),
            spacing=4,
        )  # fmt: skip
        last = row((self.poke_text, 1), self.poke_button)
        column(amount, last, parent=self._poke_row, spacing=4)
        self._poke_row.hide()
        self.body.addWidget(self._poke_row)
        self._spot = pg.ScatterPlotItem(symbol="o", size=16, brush=None)
        self._spot.setZValue(8)
        self.image_view.box.addItem(self._spot)
        self._plan: PokePlan | None = None
        self._armed_until = 0.0
        self.image_view.pixel_clicked.connect(self._on_pixel_clicked)

    def _on_armed(self, armed: bool) -> None:
        self._poke_row.setVisible(armed)
        self._poke_target.setVisible(armed)
        # Room for the map, where actuators are clicked; rms and peak are in the header, too.
        self._numbers.setHidden(armed)
        self._toolbar.setHidden(armed)
        self._fit_head()
        self.arm_button.setText("Disarm" if armed else "Arm pokes")
        if not armed and self._is_held:
            self.context.session.abort()
        # The map of an idle mirror, which has sent no command yet.
        if armed and COMMAND not in self._values and self._map.n_act:
            self._values[COMMAND] = np.zeros(self._map.n_act)
            self._update_image()
        self._on_poke_edit()

    def resizeEvent(self, event: QResizeEvent) -> None:
        super().resizeEvent(event)
        self._fit_head()
        fit_height(self.poke_text)

    def _show_poke(self, text: str) -> None:
        self.poke_text.setText(text)
        fit_height(self.poke_text)

    def _fit_head(self) -> None:
        """A low panel has no room for the row above the map and the controls of a poke."""
        low = self.height() < self.context.theme.pixels(_LOW_PX)
        self._head.setHidden(low and self.arm_button.isChecked())

    def _on_pixel_clicked(self, x: int, y: int) -> None:
        if self.arm_button.isChecked() and (number := int(self._map.numbers[y, x])) >= 0:
            self._choose(ACTUATOR, number)

    def choose_mode(self, number: int) -> None:
        """Choose a mode, which is poked only if pokes are armed and the button is held."""
        if self.arm_button.isChecked() and number >= 0:
            self._choose(MODE, number)

    def _choose(self, kind: str, number: int) -> None:
        self.poke_kind.buttons[kind].setChecked(True)
        self.poke_number.setValue(number + _FIRST[kind])
        self._on_poke_edit()

    def _on_kind(self, kind: str) -> None:
        self.poke_number.setValue(max(self.poke_number.value(), _FIRST[kind]))
        self._on_poke_edit()

    def _on_poke_edit(self) -> None:
        """Mark the actuator and request the plan of the poke."""
        self._plan = None
        self._armed_until = time.monotonic() + ARMED_S
        kind, number, *_ = request = self._poke_request
        armed = self.arm_button.isChecked()
        rows, columns = np.nonzero(self._map.numbers == number)
        marked = armed and kind == ACTUATOR and rows.size > 0
        self._spot.setData([columns.mean() + 0.5] if marked else [], [rows.mean() + 0.5] if marked else [])
        if not armed:
            return
        self.poke_number.low = _FIRST[kind]
        for box in (self.poke_number, self.poke_amplitude, self.poke_seconds):
            if not box.low <= box.value() <= box.high:
                self._show_poke(
                    f"{box.accessibleName()}: {box.value():g} is out of range: {box.low:g} to {box.high:g}"
                )
                return
        self.context.session.ask(
            "plan the poke", lambda server: server.check_poke(*request),
            lambda plan: self._show_plan(plan, request), self._show_poke, quiet=True,
        )  # fmt: skip

    @property
    def _poke_request(self) -> tuple[str, int, float, float]:
        kind = self.poke_kind.selected
        number = round(self.poke_number.value()) - _FIRST[kind]
        return kind, number, self.poke_amplitude.value(), self.poke_seconds.value()

    def _show_plan(self, plan: PokePlan, request: tuple[str, int, float, float]) -> None:
        if request == self._poke_request:
            self._plan = plan
            self._show_poke(
                plan.refusal or f"{plan.description} for {request[3]:g} s; limit ±{plan.allowed:.3g}"
            )

    def _poke(self) -> None:
        if self._plan is None or not self.poke_button.isEnabled():
            return
        request, description = self._poke_request, self._plan.description
        # The button is disabled while the poke is held, and would pass its focus on to any widget.
        self.arm_button.setFocus()
        self._armed_until = time.monotonic() + ARMED_S
        self.context.session.ask(
            "poke the mirror", lambda server: server.poke(*request),
            lambda _: self._show_poke(f"Held: {description}"), self._show_poke, quiet=True,
        )  # fmt: skip

    @property
    def _is_held(self) -> bool:
        run = self.context.session.source.state.active_run
        return run is not None and run.name == "poke"

    def tick(self, source: DataSource) -> None:
        """Enable the buttons; disarm when nothing may be changed, or after a while without a poke."""
        now = self.context.session.request_context
        reason = reason_no_poke(now)
        held, armed = self._is_held, self.arm_button.isChecked()
        if armed and not held and (reason or time.monotonic() > self._armed_until):
            self.arm_button.setChecked(False)
        tip = "Allow pokes of single actuators and modes; each needs a second step."
        set_available(self.arm_button, tip, "" if held else reason)
        plan = self._plan
        refused = "no plan yet" if plan is None else "see above" if plan.refusal else ""
        set_available(self.poke_button, _POKE_TIP, reason or refused)
        if armed and not held and plan is not None and self.poke_text.text().startswith("Held"):
            # Kind and number; the amplitude is in the fields above.
            self._show_poke(f"Mirror flat again after: {plan.description.partition(' at ')[0]}")

    # ------------------------------------------------------------ data
    def on_geometry(self) -> None:
        self._map = ActuatorImage(self.bench_geometry)
        self._nm_per_stroke = 1e9 * self.bench_geometry.stroke_m
        self._show_numbers()
        self.image_view.clear()
        self._update_image()

    def on_state(self, state: State) -> None:
        self._state = state
        self._show_numbers()

    def _show_numbers(self) -> None:
        state, mirror = self._state, self._state.mirror
        nm = self._nm_per_stroke
        values = {
            "rms": f"{mirror.rms:.4f}",
            "rms_nm": f"{nm * mirror.rms:.0f}" if nm else UNKNOWN_VALUE,
            "peak": f"{mirror.peak:.4f}",
            "peak_nm": f"{nm * mirror.peak:.0f}" if nm else UNKNOWN_VALUE,
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
            self.image_view.second_unit = None
        else:
            self.image_view.unit, nm = "stroke", self._nm_per_stroke
            self.image_view.second_unit = (nm, "nm") if nm else None
        self.image_view.show_array(self._map.to_image(values))
        level, second = self.image_view.levels[1], self.image_view.second_unit
        nm_text = "" if second is None else f" = {second[0] * level:.0f} nm"
        is_flat = not np.any(np.abs(values) > _FLAT_LEVEL)
        self.scale.setText("flat" if is_flat else f"±{level:.3g} {self.image_view.unit}{nm_text}")

    def _update_measured_button(self) -> None:
        button = self.choice.buttons[MEASURED]
        button.setEnabled(MEASURED in self._values)
        button.setVisible(MEASURED in self._values)
        self.choice.setVisible(MEASURED in self._values)

    def clear(self) -> None:
        self._values.clear()
        self.image_view.clear()
        self.choice.choose(COMMAND)
        self.arm_button.setChecked(False)
        self._update_measured_button()

    def apply_theme(self) -> None:
        theme = self.context.theme
        self.scale.setFont(theme.font(0.9, mono=True))
        self._spot.setPen(pg.mkPen(theme.colour("warn"), width=2))
        for box, width in ((self.poke_number, 64), (self.poke_amplitude, 72), (self.poke_seconds, 64)):
            box.setFont(theme.font(mono=True))
            box.setMinimumWidth(theme.pixels(width))

    def export_arrays(self) -> tuple[ExportArray, ...]:
        units = {COMMAND: "stroke", MEASURED: "m"}
        return tuple(ExportArray(key, np.asarray(data), units[key]) for key, data in self._values.items())
