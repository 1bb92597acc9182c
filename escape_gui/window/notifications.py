"""Notifications in the status bar, and their derivation from changes of the server state."""

from __future__ import annotations

from PySide6.QtCore import Qt, QTimer
from PySide6.QtGui import QResizeEvent
from PySide6.QtWidgets import QFrame, QHBoxLayout, QLabel, QSizePolicy, QToolButton, QWidget

from escape_gui.theme import Theme
from escape_gui.widgets.controls.status_indicator import Level, StatusIndicator
from escape_hw.remote.state import Finish, State

#: How long a note stays; one about something bad stays until it is closed.
DISPLAY_MS = 6000
_MAX_NOTIFICATIONS = 4


class Notification(QFrame):
    """One note in one line; what does not fit stands in the tooltip.

    Parameters
    ----------
    theme
        Look.
    level, title, text
        What it says.
    """

    def __init__(self, theme: Theme, level: Level, title: str, text: str) -> None:
        super().__init__()
        self.title, self.text, self.level = title, text, level
        self._line = " · ".join(line.strip() for line in text.splitlines() if line.strip())
        pill = StatusIndicator(theme)
        pill.set_status(level, title)
        self.close_button = QToolButton()
        self.close_button.setObjectName("quiet")
        self.close_button.setText("×")
        self.close_button.setAccessibleName("Close this note")
        self._words = QLabel(self._line)
        self._words.setTextFormat(Qt.TextFormat.PlainText)
        self._words.setTextInteractionFlags(Qt.TextInteractionFlag.TextSelectableByMouse)
        # It takes what room there is and asks for none: a long reason must not make the window wider.
        self._words.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Fixed)
        row = QHBoxLayout(self)
        row.setContentsMargins(0, 0, 0, 0)
        row.setSpacing(8)
        row.addWidget(pill)
        row.addWidget(self._words, 1)
        row.addWidget(self.close_button)
        self.setToolTip(f"{title}\n{text}".strip())
        self.setAccessibleName(f"{title}: {text}")

    def resizeEvent(self, event: QResizeEvent) -> None:
        """Cut the words where the room ends."""
        super().resizeEvent(event)
        metrics = self._words.fontMetrics()
        self._words.setText(metrics.elidedText(self._line, Qt.TextElideMode.ElideRight, self._words.width()))


class NotificationBar(QWidget):
    """The notes of a window: the newest is seen, the others come back when it goes.

    Parameters
    ----------
    theme
        Look.
    """

    def __init__(self, theme: Theme) -> None:
        super().__init__()
        self._theme = theme
        self._row = QHBoxLayout(self)
        self._row.setContentsMargins(8, 0, 8, 0)
        self._row.setSpacing(8)
        self._more = QLabel()
        self._more.setObjectName("caption")
        self._row.addWidget(self._more)
        self.notes: list[Notification] = []
        # Room for a note is always kept, so that no panel moves when one comes.
        self.setMinimumHeight(self._height())
        theme.changed.connect(lambda: self.setMinimumHeight(self._height()))
        self._show_newest()

    def show_message(self, level: Level, title: str, text: str, *, persistent: bool | None = None) -> None:
        """Show a note until its time is over, or until it is closed; the oldest goes when there are many."""
        while len(self.notes) >= _MAX_NOTIFICATIONS:
            self._remove(self.notes[0])
        note = Notification(self._theme, level, title, text)
        note.close_button.clicked.connect(lambda: self._remove(note))
        self.notes.append(note)
        self._row.insertWidget(0, note, 1)
        if not (level is Level.ERROR if persistent is None else persistent):
            timer = QTimer(note)
            timer.setSingleShot(True)
            timer.timeout.connect(lambda: self._remove(note))
            timer.start(DISPLAY_MS)
        self._show_newest()

    def _remove(self, note: Notification) -> None:
        if note in self.notes:
            self.notes.remove(note)
            self._row.removeWidget(note)
            note.hide()
            note.deleteLater()
            self._show_newest()

    def _show_newest(self) -> None:
        for note in self.notes:
            note.setVisible(note is self.notes[-1])
        others = len(self.notes) - 1
        self._more.setText(f"+{others}" if others > 0 else "")
        self._more.setToolTip("Notes behind this one" if others > 0 else "")

    def _height(self) -> int:
        return self._theme.pixels(26)


_LEVELS = {Finish.DONE: Level.GOOD, Finish.ABORTED: Level.WARNING, Finish.FAILED: Level.ERROR}


class StateNotifier:
    """Compares each state with the one before.

    Parameters
    ----------
    toasts
        Where notes are shown.
    """

    def __init__(self, notifications: NotificationBar) -> None:
        self._toasts = notifications
        self._state: State | None = None
        self._connected = False

    def update(self, state: State, *, connected: bool) -> None:
        """Tell what is new."""
        before, was_connected = self._state, self._connected
        self._state, self._connected = state, connected
        if was_connected and not connected:
            self._toasts.show_message(
                Level.ERROR,
                "Server lost",
                "No word from the server. The window tries again by itself.",
                persistent=False,
            )
        if not connected:
            return
        if before is None or not was_connected:
            for note in state.notes:
                self._toasts.show_message(Level.WARNING, "Found at start", note)
        if before is None:
            return
        if state.fault is not None and state.fault != before.fault:
            self._toasts.show_message(Level.ERROR, "Fault, mirror made safe", state.fault.reason)
        if state.last_run is not None and state.last_run != before.last_run:
            last = state.last_run
            where = f"\n{last.folder}" if last.folder else ""
            self._toasts.show_message(
                _LEVELS[last.finish], f"{last.name} {last.finish.value}", f"{last.message}{where}".strip()
            )
