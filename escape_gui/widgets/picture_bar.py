"""The row under a picture: place and value under the cursor, scale, levels, colours."""

from __future__ import annotations

from PySide6.QtCore import Qt
from PySide6.QtWidgets import QHBoxLayout, QLabel, QSizePolicy, QToolButton, QWidget

from escape_gui.theme import Theme
from escape_gui.widgets.picture import Picture


class PictureBar(QWidget):
    """Belongs to one picture.

    Parameters
    ----------
    theme
        Fonts.
    picture
        Its picture.
    logarithmic
        Whether the choice of a logarithmic scale makes sense.
    """

    def __init__(self, theme: Theme, picture: Picture, *, logarithmic: bool = True) -> None:
        super().__init__()
        self._theme = theme
        self.cursor_value = QLabel()
        self.cursor_value.setTextFormat(Qt.TextFormat.PlainText)
        self.cursor_value.setAccessibleName("Value under the cursor")
        # A longer value must not widen the dock.
        self.cursor_value.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Preferred)
        picture.pointed.connect(self.cursor_value.setText)
        row = QHBoxLayout(self)
        row.setContentsMargins(0, 0, 0, 0)
        row.setSpacing(2)
        row.addWidget(self.cursor_value, 1)
        if logarithmic:
            self.log_button = _switch("log", "Logarithmic scale (L)", picture.logarithmic)
            self.log_button.toggled.connect(picture.set_logarithmic)
            row.addWidget(self.log_button)
        self.hold_button = _switch(
            "hold levels", "Keep black and white where they are", not picture.automatic
        )
        self.hold_button.toggled.connect(lambda on: picture.set_automatic(not on))
        row.addWidget(self.hold_button)
        theme.changed.connect(self._restyle)
        self._restyle()

    def _restyle(self) -> None:
        self.cursor_value.setFont(self._theme.font(0.9, mono=True))


def _switch(text: str, tip: str, on: bool) -> QToolButton:
    button = QToolButton()
    button.setObjectName("quiet")
    button.setText(text)
    button.setToolTip(tip)
    button.setAccessibleName(tip)
    button.setCheckable(True)
    button.setChecked(on)
    return button
