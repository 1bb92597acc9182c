"""A row of exclusive buttons, and a button that must be held."""

from __future__ import annotations

from collections.abc import Sequence

from PySide6.QtCore import QElapsedTimer, QRectF, QTimer, Signal
from PySide6.QtGui import QKeyEvent, QPainter, QPaintEvent, Qt
from PySide6.QtWidgets import QButtonGroup, QPushButton, QSizePolicy, QToolButton, QWidget

from escape_gui.theme import Theme
from escape_gui.widgets.layouts import flat_button, row

HOLD_MS = 800
_STEP_MS = 40


class SegmentedButton(QWidget):
    """A row of buttons of which exactly one is pressed, at the start the first."""

    chosen = Signal(str)

    def __init__(self, name: str, choices: Sequence[str], tips: Sequence[str]) -> None:
        super().__init__()
        self.setAccessibleName(name)
        group = QButtonGroup(self)
        self.buttons: dict[str, QToolButton] = {}
        for text, tip in zip(choices, tips, strict=True):
            button = flat_button(text, tip, checkable=True, checked=not self.buttons)
            button.setAccessibleName(f"{name}: {text}")
            button.clicked.connect(lambda _=False, text=text: self.chosen.emit(text))
            group.addButton(button)
            self.buttons[text] = button
        row(*self.buttons.values(), parent=self, spacing=2)
        self.setSizePolicy(QSizePolicy.Policy.Maximum, QSizePolicy.Policy.Fixed)

    @property
    def selected(self) -> str:
        return next(text for text, button in self.buttons.items() if button.isChecked())

    def choose(self, text: str) -> None:
        self.buttons[text].click()


class HoldButton(QPushButton):
    """A button for hazardous actions: emits :attr:`confirmed` after it was held for :data:`HOLD_MS`.

    It can be held with the mouse, Space or Return; a growing bar shows the time.
    """

    confirmed = Signal()

    def __init__(self, text: str, theme: Theme) -> None:
        super().__init__(f"Hold to {text}")
        self._theme = theme
        self._clock = QElapsedTimer()
        self._timer = QTimer(self)
        self._timer.setInterval(_STEP_MS)
        self._timer.timeout.connect(self._step)
        self.pressed.connect(self._begin)
        self.released.connect(self._end)

    def _begin(self) -> None:
        self._clock.start()
        self._timer.start()

    def _end(self) -> None:
        self._timer.stop()
        self.update()

    def _step(self) -> None:
        if self._clock.elapsed() >= HOLD_MS:
            self._timer.stop()
            self.setDown(False)
            self.confirmed.emit()
        self.update()

    def keyPressEvent(self, event: QKeyEvent) -> None:
        """Treat Return like Space; a key that repeats automatically is one press."""
        if event.key() in (Qt.Key.Key_Return, Qt.Key.Key_Enter):
            if not event.isAutoRepeat() and not self.isDown():
                self.setDown(True)
                self.pressed.emit()
            return
        super().keyPressEvent(event)

    def keyReleaseEvent(self, event: QKeyEvent) -> None:
        if event.key() in (Qt.Key.Key_Return, Qt.Key.Key_Enter):
            if not event.isAutoRepeat() and self.isDown():
                self.setDown(False)
                self.released.emit()
            return
        super().keyReleaseEvent(event)

    def paintEvent(self, event: QPaintEvent) -> None:
        super().paintEvent(event)
        if self._timer.isActive():
            share = min(self._clock.elapsed() / HOLD_MS, 1.0)
            bar = QRectF(0, self.height() - 4, self.width() * share, 4)
            QPainter(self).fillRect(bar, self._theme.colour("warn"))
