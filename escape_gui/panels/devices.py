"""Devices and their health."""

from __future__ import annotations

from typing import ClassVar

from PySide6.QtWidgets import QFrame, QLabel, QVBoxLayout, QWidget

from escape_gui.panels.base import Context, Panel
from escape_gui.widgets.controls import HEALTH_LEVELS, StatusIndicator, column, row, scroll_area, text_label
from escape_hw.remote.state import DeviceState, State

#: Titles of the keys of ``[devices]``.
ROLES = {
    "dm": "Deformable mirror",
    "wfs": "Sensor camera",
    "science": "Science camera",
    "screen": "Turbulence",
    "modulator": "Modulator",
}
_NO_BREAK_SPACE = "\u00a0"
#: Unit and digits after the decimal point by suffix of a fact's key.
_UNITS = {
    "_c": ("°C", 1), "_hz": ("Hz", 1), "_us": ("µs", 0), "_ms": ("ms", 2), "_s": ("s", 3), "_mm": ("mm", 2),
    "_um": ("µm", 2),
}  # fmt: skip


class DevicesPanel(Panel):
    """One row for each device."""

    name: ClassVar[str] = "devices"
    title: ClassVar[str] = "Devices"
    help: ClassVar[str] = (
        "The devices of the system with their health: ok, stale (no data for longer than the period of the "
        "device), lost, fault, closed. Model, serial number and readings are below each name."
    )
    placeholder: ClassVar[str] = (
        "No devices yet.\nStart a server with 'escape serve SYSTEM', or wait until it is ready."
    )

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._rows: dict[str, _DeviceRow] = {}
        content = QWidget()
        self._column: QVBoxLayout = column(None, parent=content, spacing=4)
        area = scroll_area(content)
        area.setAccessibleName("List of devices")
        self.body.addWidget(area)

    def on_state(self, state: State) -> None:
        names = [device.name for device in state.devices]
        if names != list(self._rows):
            self.clear()
            for name in names:
                self._rows[name] = _DeviceRow(self.context)
                self._column.insertWidget(self._column.count() - 1, self._rows[name])
        for device in state.devices:
            self._rows[device.name].show_device(device)
        self.show_placeholder(not names)

    def clear(self) -> None:
        for one in self._rows.values():
            self._column.removeWidget(one)
            one.hide()
            one.deleteLater()
        self._rows.clear()


class _DeviceRow(QFrame):
    def __init__(self, context: Context) -> None:
        super().__init__()
        self._theme = context.theme
        self._indicator = StatusIndicator(context.theme, "closed")
        self._name, self._model, self._facts = QLabel(), text_label(), text_label()
        self._model.setObjectName("caption")
        head = row(self._name, None, self._indicator)
        column(head, self._model, self._facts, parent=self, spacing=0).setContentsMargins(4, 4, 4, 4)
        context.theme.follow(self._apply_theme)

    def show_device(self, device: DeviceState) -> None:
        role = ROLES.get(device.name, device.name)
        self._name.setText(role)
        self._indicator.set_status(HEALTH_LEVELS[device.health], device.health.value)
        mode = "" if device.model.startswith("simulated") else "simulated" if device.simulated else "hardware"
        self._model.setText(
            " · ".join(part for part in (device.model or device.kind, device.serial, mode) if part)
        )
        facts = "   ".join(
            format_fact(key, value, simulated=device.simulated).replace(" ", _NO_BREAK_SPACE)
            for key, value in device.facts.items()
        )
        self._facts.setText("\n".join(line for line in (facts, device.message) if line))
        self._facts.setVisible(bool(facts or device.message))
        self.setAccessibleName(f"{role}: {device.health.value}. {device.message}")

    def _apply_theme(self) -> None:
        self._name.setFont(self._theme.font(bold=True))
        self._facts.setFont(self._theme.font(0.95, mono=True))


def format_fact(key: str, value: float | str, *, simulated: bool = False) -> str:
    """A reading with its unit: ``temperature_c: 31.24`` becomes ``temperature 31.2 °C``.

    Rates of a simulated device are those of its own clock, and are marked.
    """
    if simulated and key.endswith("rate_hz"):
        key = f"simulated_{key}"
    for suffix, (unit, digits) in _UNITS.items():
        if key.endswith(suffix) and not isinstance(value, str):
            return f"{key.removesuffix(suffix).replace('_', ' ')} {value:.{digits}f} {unit}"
    text = value if isinstance(value, str) else f"{value:g}"
    return f"{key.replace('_', ' ')} {text}"
