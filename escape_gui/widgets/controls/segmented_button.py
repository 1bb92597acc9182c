"""A row of buttons of which one is down: the few ways to look at the same thing."""

from __future__ import annotations

from collections.abc import Sequence

from PySide6.QtCore import Signal
from PySide6.QtWidgets import QButtonGroup, QHBoxLayout, QSizePolicy, QToolButton, QWidget


class SegmentedButton(QWidget):
    """One of several words.

    Parameters
    ----------
    name
        What is chosen, for screen readers.
    words
        The choices; the first is taken to begin with.
    tips
        What each shows.
    """

    chosen = Signal(str)

    def __init__(self, name: str, words: Sequence[str], tips: Sequence[str] = ()) -> None:
        super().__init__()
        self.setAccessibleName(name)
        row = QHBoxLayout(self)
        row.setContentsMargins(0, 0, 0, 0)
        row.setSpacing(2)
        group = QButtonGroup(self)
        self.buttons: dict[str, QToolButton] = {}
        for k, word in enumerate(words):
            button = QToolButton()
            button.setObjectName("quiet")
            button.setText(word)
            button.setCheckable(True)
            button.setChecked(k == 0)
            button.setAccessibleName(f"{name}: {word}")
            button.setToolTip(tips[k] if tips else word)
            button.clicked.connect(lambda _=False, word=word: self.chosen.emit(word))
            group.addButton(button)
            row.addWidget(button)
            self.buttons[word] = button
        self.setSizePolicy(QSizePolicy.Policy.Maximum, QSizePolicy.Policy.Fixed)

    @property
    def word(self) -> str:
        """The word chosen."""
        return next(word for word, button in self.buttons.items() if button.isChecked())

    def choose(self, word: str) -> None:
        """Choose as if the button had been pressed."""
        self.buttons[word].click()
