"""Dialog with the limits of the alarms."""

from __future__ import annotations

from PySide6.QtWidgets import QCheckBox, QDialog, QDialogButtonBox, QGridLayout, QLabel, QWidget

from escape_gui.client.alarms import RULES
from escape_gui.settings import Settings
from escape_gui.widgets.controls import caption, column, text_label
from escape_gui.widgets.inputs import NumberBox


class AlarmDialog(QDialog):
    """Edits the limits of ``settings`` in place; they act from OK on."""

    def __init__(self, window: QWidget, settings: Settings) -> None:
        super().__init__(window)
        self._settings = settings
        self.setWindowTitle("Alarms")
        grid = QGridLayout()
        self.switches: dict[str, QCheckBox] = {}
        self.limits: dict[str, NumberBox] = {}
        for line, rule in enumerate(RULES):
            switch = QCheckBox(f"{rule.label} {'below' if rule.below else 'above'}")
            box = NumberBox(rule.low, rule.high, step=1, decimals=2)
            box.setAccessibleName(f"Limit of {rule.label}")
            box.edited.connect(lambda switch=switch: switch.setChecked(True))
            self.switches[rule.name], self.limits[rule.name] = switch, box
            for place, widget in enumerate((switch, box, caption(rule.unit))):
                grid.addWidget(widget, line, place)
        self.muted = QCheckBox("Mute the sound")
        self.message = text_label()
        buttons = QDialogButtonBox(
            QDialogButtonBox.StandardButton.Ok | QDialogButtonBox.StandardButton.Cancel
        )
        buttons.accepted.connect(self._apply)
        buttons.rejected.connect(self.reject)
        note = QLabel(
            "An alarm is raised after a second beyond its limit, and stays until it is acknowledged. "
            "A quantity that is not measured raises none."
        )
        note.setWordWrap(True)
        column(note, grid, self.muted, self.message, buttons, parent=self).setContentsMargins(16, 16, 16, 16)

    def open_settings(self) -> None:
        """Show the present limits."""
        for rule in RULES:
            limit = self._settings.alarms.get(rule.name)
            self.switches[rule.name].setChecked(limit is not None)
            self.limits[rule.name].setValue(rule.default if limit is None else limit)
        self.muted.setChecked(self._settings.alarms_muted)
        self.message.clear()
        self.show()

    def _apply(self) -> None:
        chosen = {
            rule.name: self.limits[rule.name].value()
            for rule in RULES
            if self.switches[rule.name].isChecked()
        }
        for rule in RULES:
            value = chosen.get(rule.name)
            if value is not None and not rule.low <= value <= rule.high:
                self.message.setText(
                    f"{rule.label}: {value:g} is out of range: {rule.low:g} to {rule.high:g}"
                )
                return
        self._settings.alarms.clear()
        self._settings.alarms.update(chosen)
        self._settings.alarms_muted = self.muted.isChecked()
        self.accept()
