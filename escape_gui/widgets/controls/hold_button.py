"""A button for what is dangerous to switch on: it must be held, and shows for how much longer."""

from __future__ import annotations

from PySide6.QtCore import QElapsedTimer, QRectF, QTimer, Signal
from PySide6.QtGui import QKeyEvent, QPainter, QPaintEvent, Qt
from PySide6.QtWidgets import QPushButton

from escape_gui.theme import Theme

HOLD_MS = 800
_STEP_MS = 40


class HoldButton(QPushButton):
    """Emits :attr:`confirmed` after it was pressed for :data:`HOLD_MS`, by mouse, Space or Return.

    Parameters
    ----------
    text
        What happens; "hold to" is put before it.
    theme
        Colours.
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
        """Return presses as Space does, and a key that repeats by itself is still the same press."""
        if event.key() in (Qt.Key.Key_Return, Qt.Key.Key_Enter):
            if not event.isAutoRepeat() and not self.isDown():
                self.setDown(True)
                self.pressed.emit()
            return
        super().keyPressEvent(event)

    def keyReleaseEvent(self, event: QKeyEvent) -> None:
        """Letting go too early does nothing."""
        if event.key() in (Qt.Key.Key_Return, Qt.Key.Key_Enter):
            if not event.isAutoRepeat() and self.isDown():
                self.setDown(False)
                self.released.emit()
            return
        super().keyReleaseEvent(event)

    def paintEvent(self, event: QPaintEvent) -> None:
        """The button with a bar along its foot that grows while it is held."""
        super().paintEvent(event)
        if self._timer.isActive():
            painter = QPainter(self)
            share = min(self._clock.elapsed() / HOLD_MS, 1.0)
            foot = QRectF(0, self.height() - 4, self.width() * share, 4)
            painter.fillRect(foot, self._theme.colour("warn"))
