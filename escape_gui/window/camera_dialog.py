"""Dialog with the settings of a camera: check, apply; dark frame and flat."""

from __future__ import annotations

from functools import partial
from typing import Any

from PySide6.QtWidgets import QCheckBox, QDialog, QGridLayout, QPushButton, QWidget

from escape_gui.client.availability import reason_no_change, reason_no_engine, reason_no_start
from escape_gui.client.session import Session
from escape_gui.theme import Theme
from escape_gui.widgets.controls import caption, column, row, set_available, text_label
from escape_gui.widgets.inputs import NumberBox
from escape_hw.remote.state import CameraPlan, CameraValues, Phase

TITLES = {"wfs": "Sensor camera", "science": "Science camera"}
#: Label, unit, factor from the server's unit, limits, step and decimals of each number.
_FIELDS: dict[str, tuple[str, str, float, float, float, float, int]] = {
    "exposure_s": ("Exposure", "ms", 1e3, 0.001, 60_000, 0.1, 4),
    "frame_rate_hz": ("Frame rate", "Hz", 1.0, 0.01, 20_000, 10, 3),
    "gain_db": ("Gain", "dB", 1.0, 0, 48, 1, 2),
    **{
        name: (label, "px", 1.0, low, 16_384, 2, 0)
        for name, label, low in (
            ("x", "Region, first column", 0), ("y", "Region, first row", 0), ("width", "Region, columns", 1),
            ("height", "Region, rows", 1),
        )
    },
}  # fmt: skip
_REGION = ("x", "y", "width", "height")


class CameraDialog(QDialog):
    """Edits the settings of one camera; nothing changes before Check and Apply."""

    def __init__(self, window: QWidget, session: Session, theme: Theme, camera: str) -> None:
        super().__init__(window)
        self._session, self._theme, self.camera = session, theme, camera
        self.setWindowTitle(f"{TITLES[camera]}: settings")
        #: Settings of the camera, once they were read from the engine that runs now.
        self._current: CameraValues | None = None
        #: Engine, and its phase, from which they were requested last.
        self._engine_pid, self._requested_in = 0, Phase.STARTING
        #: Fields that were edited since they were applied.
        self._edited: set[str] = set()
        self._checked: dict[str, Any] = {}
        grid = QGridLayout()
        grid.setHorizontalSpacing(12)
        for k, text in ((1, "Current"), (2, "Setpoint")):
            grid.addWidget(caption(text), 0, k)
        self.fields: dict[str, NumberBox] = {}
        self.current = {name: caption("–") for name in _FIELDS}
        for line, (name, (label, unit, _, low, high, step, decimals)) in enumerate(_FIELDS.items(), 1):
            field = self.fields[name] = NumberBox(low, high, step=step, decimals=decimals)
            field.setAccessibleName(f"{label} setpoint")
            field.edited.connect(partial(self._on_edit, name))
            field.lineEdit().returnPressed.connect(self.check)
            for place, widget in enumerate((caption(label), self.current[name], field, caption(unit))):
                grid.addWidget(widget, line, place)
        self.check_button, self.apply_button = QPushButton("Check"), QPushButton("Apply")
        self.revert_button, close = QPushButton("Revert"), QPushButton("Close")
        self.dark_button, self.flat_button = QPushButton("Measure dark"), QPushButton("Measure flat")
        self.blocked = QCheckBox("The beam is blocked by hand")
        self.blocked.setToolTip("Where there is no beam stop under remote control")
        for button, handler in (
            (self.check_button, self.check), (self.apply_button, self.apply),
            (self.revert_button, self.revert), (close, self.reject),
            (self.dark_button, self._measure_dark), (self.flat_button, self._measure_flat),
        ):  # fmt: skip
            button.setAutoDefault(False)
            button.clicked.connect(handler)
        self.message = text_label()
        pixels = QWidget()
        row(self.dark_button, self.blocked, self.flat_button, None, parent=pixels)
        pixels.setVisible(camera == "wfs")
        buttons = row(self.check_button, self.apply_button, self.revert_button, None, close)
        column(grid, buttons, self.message, None, pixels, parent=self).setContentsMargins(16, 16, 16, 16)
        theme.follow(self._apply_theme)

    def open_settings(self) -> None:
        """Show the dialog with the present settings."""
        self._current = None
        self._edited.clear()
        self._request_current()
        self.show()
        self.raise_()
        self.fields["exposure_s"].setFocus()
        self.update_buttons()

    def _request_current(self, then: str = "") -> None:
        state = self._session.source.state
        self._engine_pid, self._requested_in = state.engine_pid, state.phase
        self._show_message(then or "Reading the settings…")
        self._session.ask(
            "read the camera's settings", lambda server: server.check_camera(self.camera),
            lambda plan: self._show_current(plan, then), self._on_error, quiet=True,
        )  # fmt: skip

    def _show_current(self, plan: CameraPlan, message: str) -> None:
        self._current = plan.current
        for name, text in _texts(plan.current).items():
            self.current[name].setText(text)
        self._follow()
        self._show_message(message or plan.refusal)
        self.update_buttons()

    # ------------------------------------------------------------ edit, check, apply
    def revert(self) -> None:
        """Put the current settings into the fields."""
        self._edited.clear()
        self._follow()
        self._show_message("")
        self.update_buttons()

    def _follow(self) -> None:
        """Show the current settings in the fields that were not edited."""
        self._checked = {}
        if self._current is not None:
            for name, value in _values(self._current).items():
                if name not in self._edited:
                    self.fields[name].setValue(value)

    def _on_edit(self, name: str) -> None:
        self._edited.add(name)
        self._checked = {}
        self._show_message("")
        self.update_buttons()

    def changed(self) -> dict[str, Any]:
        """The settings that differ from the current ones, as arguments of a request."""
        if self._current is None:
            return {}
        now = _values(self._current)
        edited = {
            name: field.value()
            for name, field in self.fields.items()
            if f"{field.value():.{field.decimals()}f}" != f"{now[name]:.{field.decimals()}f}"
        }
        wanted: dict[str, Any] = {
            name: value / _FIELDS[name][2] for name, value in edited.items() if name not in _REGION
        }
        if edited.keys() & set(_REGION):
            wanted["region"] = tuple(round(self.fields[name].value()) for name in _REGION)
        return wanted

    def check(self) -> None:
        """Ask the server what the edited settings would change."""
        if self._current is None:
            return
        for name, field in self.fields.items():
            if not field.low <= field.value() <= field.high:
                label = _FIELDS[name][0]
                reason = f"{label} {field.value():g} is out of range: {field.low:g} to {field.high:g}"
                return self._show_message(reason, bad=True)
        wanted = self.changed()
        if not wanted:
            return self._show_message("No changes.")
        self._show_message("Checking…")
        self._session.ask(
            "check the settings", lambda server: server.check_camera(self.camera, **wanted),
            lambda plan: self._on_checked(plan, wanted), self._on_error, quiet=True,
        )  # fmt: skip

    def _on_checked(self, plan: CameraPlan, wanted: dict[str, Any]) -> None:
        if wanted != self.changed():
            return
        lines = [", ".join(plan.changes) or "No changes: this is the nearest that the camera can do."]
        lines += plan.warnings
        if plan.refusal:
            lines.append(f"Not now: {plan.refusal}.")
        self._checked = wanted if plan.changes and not plan.refusal else {}
        self._show_message("\n".join(lines), bad=bool(plan.refusal))
        self.update_buttons()

    def apply(self) -> None:
        """Apply the checked settings."""
        wanted = self._checked
        if wanted:
            self._show_message("Waiting for the camera…")
            self._session.ask(
                "change the camera", lambda server: server.set_camera(self.camera, **wanted),
                lambda plan: self._on_applied(plan, wanted), self._on_error, quiet=True,
            )  # fmt: skip

    def _on_applied(self, plan: CameraPlan, wanted: dict[str, Any]) -> None:
        if self.changed() == wanted:
            self._edited.clear()
        self._request_current(f"Applied: {', '.join(plan.changes)}")

    def _measure_dark(self) -> None:
        by_hand = self.blocked.isChecked()
        self._start("dark", {"blocked_by_hand": by_hand} if by_hand else {})

    def _measure_flat(self) -> None:
        self._start("flat", {})

    def _start(self, procedure: str, arguments: dict[str, Any]) -> None:
        started = f"The measurement of the {procedure} has started; its end is reported in the log."
        self._session.ask(
            f"measure the {procedure}", lambda server: server.start(procedure, **arguments),
            lambda _: self._show_message(started), self._on_error, quiet=True,
        )  # fmt: skip

    # ------------------------------------------------------------ display
    def update_buttons(self) -> None:
        """Enable what is possible now; called by the window while the dialog is visible."""
        now = self._session.request_context
        state = now.state
        if state.engine_pid != self._engine_pid:
            self._current = None  # of another engine
        if self._current is None and (state.engine_pid, state.phase) != (
            self._engine_pid, self._requested_in,
        ):  # fmt: skip
            self._request_current()
        unread = "the settings were not read yet" if self._current is None else ""
        unchecked = "" if self._checked else "press Check first"
        set_available(
            self.check_button,
            "Ask the camera what it can do; nothing changes.",
            reason_no_engine(now) or unread,
        )
        set_available(self.apply_button, "Apply the checked settings.", reason_no_change(now) or unchecked)
        idle = "" if now.state.phase is Phase.IDLE else "the bench is not idle"
        set_available(
            self.dark_button, "Average 100 frames with the beam blocked.", reason_no_start(now) or idle
        )
        set_available(self.flat_button, "Average 100 frames in uniform light.", reason_no_start(now) or idle)

    def _on_error(self, reason: str) -> None:
        self._checked = {}
        self._show_message(reason, bad=True)
        self.update_buttons()

    def _show_message(self, text: str, *, bad: bool = False) -> None:
        self.message.setText(text)
        colour = self._theme.colour("bad" if bad else "text").name()
        self.message.setStyleSheet(f"color: {colour};")

    def _apply_theme(self) -> None:
        for label in (*self.current.values(), *self.fields.values()):
            label.setFont(self._theme.font(mono=True))
        for field in self.fields.values():
            field.setMinimumWidth(self._theme.pixels(120))
        self.message.setMinimumHeight(self._theme.pixels(64))
        self.setMinimumWidth(self._theme.pixels(420))


def _values(values: CameraValues) -> dict[str, float]:
    """Values in the units of the form, by field."""
    numbers = {name: _FIELDS[name][2] * getattr(values, name) for name in _FIELDS if name not in _REGION}
    return {**numbers, **dict(zip(_REGION, map(float, values.region), strict=True))}


def _texts(values: CameraValues) -> dict[str, str]:
    return {name: f"{value:.{_FIELDS[name][6]}f}" for name, value in _values(values).items()}
