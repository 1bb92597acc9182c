"""A number with caption and unit, and a grid of them."""

from __future__ import annotations

from PySide6.QtCore import Qt
from PySide6.QtWidgets import QGridLayout, QLabel, QSizePolicy, QWidget

from escape_gui.theme import Theme
from escape_gui.widgets.layouts import caption, row


class Readout(QWidget):
    """Caption, value and unit in a row; the value is right-aligned in a field of ``digits`` characters."""

    def __init__(self, theme: Theme, name: str, unit: str, digits: int) -> None:
        super().__init__()
        self._theme, self._name, self._unit, self._digits = theme, name, unit, digits
        self._value = QLabel("–")
        self._value.setAlignment(Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignVCenter)
        row(caption(name), self._value, caption(unit), parent=self, spacing=4)
        self.setSizePolicy(QSizePolicy.Policy.Maximum, QSizePolicy.Policy.Fixed)
        theme.changed.connect(self._apply_theme)
        self._apply_theme()

    @property
    def text(self) -> str:
        return self._value.text()

    def show_value(self, text: str) -> None:
        if text != self._value.text():
            self._value.setText(text)
            self.setAccessibleName(f"{self._name} {text} {self._unit}")

    def _apply_theme(self) -> None:
        self._value.setFont(self._theme.font(mono=True))
        self._value.setMinimumWidth(self._value.fontMetrics().horizontalAdvance("0" * self._digits))


def readout_grid(readouts: dict[str, Readout]) -> QGridLayout:
    """Readouts in two columns, left-aligned."""
    grid = QGridLayout()
    grid.setHorizontalSpacing(24)
    grid.setVerticalSpacing(2)
    for k, readout in enumerate(readouts.values()):
        grid.addWidget(readout, k // 2, k % 2)
    grid.setColumnStretch(2, 1)
    return grid
