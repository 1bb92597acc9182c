"""Devices and their health."""

from __future__ import annotations

from typing import ClassVar

from PySide6.QtCore import Qt
from PySide6.QtWidgets import QFrame, QHBoxLayout, QLabel, QScrollArea, QVBoxLayout, QWidget

from escape_gui.panels.base import Context, Panel
from escape_gui.widgets.controls.status_indicator import Level, StatusIndicator
from escape_gui.window.dock import HEALTH_LEVELS
from escape_hw.remote.state import DeviceState, State

#: What the keys in ``[devices]`` stand for.
ROLES = {
    "dm": "Deformable mirror",
    "wfs": "Sensor camera",
    "science": "Science camera",
    "screen": "Turbulence",
    "modulator": "Modulator",
}
#: A space at which no line is broken.
_NO_BREAK_SPACE = "\u00a0"
#: Endings of the keys of facts, with the unit they mean and digits after the point.
_UNITS = {
    "_c": ("°C", 1),
    "_hz": ("Hz", 1),
    "_us": ("µs", 0),
    "_ms": ("ms", 2),
    "_s": ("s", 3),
    "_mm": ("mm", 2),
    "_um": ("µm", 2),
}


class DevicesPanel(Panel):
    """One row for each device."""

    name: ClassVar[str] = "devices"
    title: ClassVar[str] = "Devices"
    help: ClassVar[str] = (
        "Every device of the system with its condition: ok, stale (silent for longer than its period), "
        "lost, fault, closed. What it says of itself stands below."
    )
    placeholder: ClassVar[str] = (
        "No devices yet.\nStart a server with 'escape serve SYSTEM', or wait until it is ready."
    )

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._rows: dict[str, _DeviceRow] = {}
        self._column = QVBoxLayout()
        self._column.setContentsMargins(0, 0, 0, 0)
        self._column.setSpacing(4)
        self._column.addStretch()
        holder = QWidget()
        holder.setLayout(self._column)
        area = QScrollArea()
        area.setWidgetResizable(True)
        area.setFrameShape(QFrame.Shape.NoFrame)
        area.setWidget(holder)
        area.setAccessibleName("List of devices")
        self.body.addWidget(area)

    def on_state(self, state: State) -> None:
        names = [device.name for device in state.devices]
        if names != list(self._rows):
            self.clear()
            for device in state.devices:
                row = self._rows[device.name] = _DeviceRow(self.context)
                self._column.insertWidget(self._column.count() - 1, row)
        for device in state.devices:
            self._rows[device.name].show_device(device)
        self.show_placeholder(not names)

    def clear(self) -> None:
        for row in self._rows.values():
            self._column.removeWidget(row)
            row.hide()
            row.deleteLater()
        self._rows.clear()


class _DeviceRow(QFrame):
    def __init__(self, context: Context) -> None:
        super().__init__()
        self._theme = context.theme
        self._pill = StatusIndicator(context.theme, "closed")
        self._name, self._model, self._facts = QLabel(), QLabel(), QLabel()
        self._model.setObjectName("caption")
        for label in (self._facts, self._model):
            label.setWordWrap(True)
            label.setTextInteractionFlags(Qt.TextInteractionFlag.TextSelectableByMouse)
        head = QHBoxLayout()
        head.addWidget(self._name)
        head.addStretch()
        head.addWidget(self._pill)
        column = QVBoxLayout(self)
        column.setContentsMargins(4, 4, 4, 4)
        column.setSpacing(0)
        column.addLayout(head)
        column.addWidget(self._model)
        column.addWidget(self._facts)
        context.theme.changed.connect(self._apply_theme)
        self._apply_theme()

    def show_device(self, device: DeviceState) -> None:
        """Bring the row up to date."""
        role = ROLES.get(device.name, device.name)
        self._name.setText(role)
        self._pill.set_status(HEALTH_LEVELS.get(device.health, Level.NEUTRAL), device.health.value)
        twin = "" if device.model.startswith("simulated") else "simulated" if device.simulated else "hardware"
        self._model.setText(
            " · ".join(part for part in (device.model or device.kind, device.serial, twin) if part)
        )
        facts = "   ".join(
            format_fact(key, value).replace(" ", _NO_BREAK_SPACE) for key, value in device.facts.items()
        )
        self._facts.setText("\n".join(line for line in (facts, device.message) if line))
        self._facts.setVisible(bool(facts or device.message))
        self.setAccessibleName(f"{role}: {device.health.value}. {device.message}")

    def _apply_theme(self) -> None:
        self._name.setFont(self._theme.font(bold=True))
        self._facts.setFont(self._theme.font(0.95, mono=True))


def format_fact(key: str, value: float | str) -> str:
    """A fact in words: ``temperature_c: 31.24`` becomes ``temperature 31.2 °C``."""
    for ending, (unit, digits) in _UNITS.items():
        if key.endswith(ending) and not isinstance(value, str):
            return f"{key.removesuffix(ending).replace('_', ' ')} {value:.{digits}f} {unit}"
    text = value if isinstance(value, str) else f"{value:g}"
    return f"{key.replace('_', ' ')} {text}"
