"""A number that changes: caption, digits that stand still, unit."""

from __future__ import annotations

from PySide6.QtCore import Qt
from PySide6.QtWidgets import QHBoxLayout, QLabel, QSizePolicy, QWidget

from escape_gui.theme import Theme


class Readout(QWidget):
    """Caption, value, unit in a row; the value has a fixed width and stands to the right.

    Parameters
    ----------
    theme
        Fonts.
    caption, unit
        Words around the number.
    digits
        Characters the value may take.
    """

    def __init__(self, theme: Theme, caption: str, unit: str, digits: int) -> None:
        super().__init__()
        self._theme, self._caption, self._digits = theme, caption, digits
        row = QHBoxLayout(self)
        row.setContentsMargins(0, 0, 0, 0)
        row.setSpacing(4)
        self._name = QLabel(caption)
        self._name.setObjectName("caption")
        self._value = QLabel("–")
        self._value.setAlignment(Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignVCenter)
        self._unit = QLabel(unit)
        self._unit.setObjectName("caption")
        for label in (self._name, self._value, self._unit):
            row.addWidget(label)
        self.setSizePolicy(QSizePolicy.Policy.Maximum, QSizePolicy.Policy.Fixed)
        theme.changed.connect(self._apply_theme)
        self._apply_theme()

    @property
    def text(self) -> str:
        """The value as shown."""
        return self._value.text()

    def show_value(self, text: str) -> None:
        """Show a value; costs nothing when it is the same."""
        if text != self._value.text():
            self._value.setText(text)
            self.setAccessibleName(f"{self._caption} {text} {self._unit.text()}")

    def _apply_theme(self) -> None:
        self._value.setFont(self._theme.font(mono=True))
        self._value.setMinimumWidth(self._value.fontMetrics().horizontalAdvance("0" * self._digits))
