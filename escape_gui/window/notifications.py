"""Notifications in the status bar, and their derivation from changes of the server state."""

from __future__ import annotations

from PySide6.QtCore import Qt, QTimer
from PySide6.QtGui import QResizeEvent
from PySide6.QtWidgets import QFrame, QLabel, QSizePolicy, QWidget

from escape_gui.theme import Theme
from escape_gui.views.procedure_form import comparison_lines
from escape_gui.widgets.controls import QUALITY_LEVELS, Level, StatusIndicator, caption, flat_button, row
from escape_hw.remote.state import Finish, Lease, State
from escape_hw.report.verdict import assess

#: Display time of a notification.
DISPLAY_MS = 6000
_MAX_NOTIFICATIONS = 4
#: Levels of notifications that stay until they are closed, the most important last.
_STAYING = (Level.WARNING, Level.ERROR)


class Notification(QFrame):
    """A notification in one line; the tooltip has the whole text."""

    def __init__(self, theme: Theme, level: Level, title: str, text: str) -> None:
        super().__init__()
        self.title, self.text, self.level = title, text, level
        self._line = " · ".join(line.strip() for line in text.splitlines() if line.strip())
        indicator = StatusIndicator(theme)
        indicator.set_status(level, title)
        self.close_button = flat_button("×", "Close this notification")
        self._label = QLabel(self._line)
        self._label.setTextFormat(Qt.TextFormat.PlainText)
        self._label.setTextInteractionFlags(Qt.TextInteractionFlag.TextSelectableByMouse)
        # A long text must not widen the window.
        self._label.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Fixed)
        row(indicator, (self._label, 1), self.close_button, parent=self)
        self.setToolTip(f"{title}\n{text}".strip())
        self.setAccessibleName(f"{title}: {text}")

    def resizeEvent(self, event: QResizeEvent) -> None:
        super().resizeEvent(event)
        metrics = self._label.fontMetrics()
        self._label.setText(metrics.elidedText(self._line, Qt.TextElideMode.ElideRight, self._label.width()))


class NotificationBar(QWidget):
    """The notifications of a window; only the newest is visible."""

    def __init__(self, theme: Theme) -> None:
        super().__init__()
        self._theme = theme
        self._more = caption()
        self._row = row(self._more, parent=self)
        self._row.setContentsMargins(8, 0, 8, 0)
        self.notifications: list[Notification] = []
        # Fixed, so that panels do not move when a notification appears.
        self.setMinimumHeight(theme.pixels(26))
        theme.changed.connect(lambda: self.setMinimumHeight(theme.pixels(26)))
        self._show_newest()

    def close_messages(self, title: str) -> None:
        """Remove the notifications of this title: their reason has passed."""
        for one in [one for one in self.notifications if one.title == title]:
            self._remove(one)

    def show_message(self, level: Level, title: str, text: str) -> None:
        """Show a notification for :data:`DISPLAY_MS`; a warning or an error until it is closed.

        If there are too many, the oldest of those that matter least makes room.
        """
        while len(self.notifications) >= _MAX_NOTIFICATIONS:
            self._remove(min(self.notifications, key=lambda one: _importance(one.level)))
        new = Notification(self._theme, level, title, text)
        new.close_button.clicked.connect(lambda: self._remove(new))
        self.notifications.append(new)
        self._row.insertWidget(0, new, 1)
        if level not in _STAYING:
            timer = QTimer(new)
            timer.setSingleShot(True)
            timer.timeout.connect(lambda: self._remove(new))
            timer.start(DISPLAY_MS)
        self._show_newest()

    def _remove(self, one: Notification) -> None:
        if one in self.notifications:
            self.notifications.remove(one)
            self._row.removeWidget(one)
            one.hide()
            one.deleteLater()
            self._show_newest()

    def _show_newest(self) -> None:
        for one in self.notifications:
            one.setVisible(one is self.notifications[-1])
        others = len(self.notifications) - 1
        self._more.setText(f"+{others}" if others > 0 else "")
        self._more.setToolTip("Older notifications" if others > 0 else "")


def _importance(level: Level) -> int:
    return _STAYING.index(level) if level in _STAYING else -1


#: Titles of notifications that are closed when their reason has passed.
_LOST, _FAULT, _TAKEN = "Server lost", "Fault, mirror made safe", "Control taken"
_STARTUP = "Startup notice"
_LEVELS = {Finish.DONE: Level.GOOD, Finish.ABORTED: Level.WARNING, Finish.FAILED: Level.ERROR}


def _was_taken(before: Lease | None, now: Lease | None) -> bool:
    """Whether another client has control; after a reconnection, the holder is the same for a while."""
    return before is not None and now is not None and now.client != before.client


def _describe_taker(lease: Lease | None) -> str:
    taker = "" if lease is None else f"{lease.name} on {lease.host} (process {lease.pid})"
    return f"{taker} has taken control; this window only shows. Ctrl+L takes it back."


class StateNotifier:
    """Shows notifications for the changes from one state to the next."""

    def __init__(self, bar: NotificationBar) -> None:
        self._bar = bar
        self._state: State | None = None
        self._connected = self._mine = False

    def update(self, state: State, *, connected: bool, mine: bool) -> None:
        """Report a lost server, start-up notices, loss of control, a fault, and the end of a procedure.

        ``mine``: this window has control.
        """
        before, was_connected, was_mine = self._state, self._connected, self._mine
        self._state, self._connected, self._mine = state, connected, mine
        if was_connected and not connected:
            why = "Connection lost; reconnecting automatically."
            self._bar.show_message(Level.ERROR, _LOST, why)
        if not connected:
            return
        self._bar.close_messages(_LOST)
        if mine:
            self._bar.close_messages(_TAKEN)
        elif was_mine and before is not None and _was_taken(before.lease, state.lease):
            self._bar.show_message(Level.ERROR, _TAKEN, _describe_taker(state.lease))
        if state.fault is None:
            self._bar.close_messages(_FAULT)
        # A front end that was restarted may have been away for less than what counts as disconnected.
        if before is None or not was_connected or state.notes != before.notes:
            self._bar.close_messages(_STARTUP)
            if state.notes:
                self._bar.show_message(Level.WARNING, _STARTUP, "\n".join(state.notes))
        if before is None:
            return
        if state.fault is not None and state.fault != before.fault:
            self._bar.show_message(Level.ERROR, _FAULT, state.fault.reason)
        recording, earlier = state.recording, before.recording
        if recording.fault and (recording.fault, recording.path) != (earlier.fault, earlier.path):
            self._bar.show_message(Level.ERROR, "Recording ended", f"{recording.fault}\n{recording.path}")
        if state.last_run is not None and state.last_run != before.last_run:
            last = state.last_run
            verdict = assess(last.document)
            level = _LEVELS[last.finish]
            if verdict is not None and last.finish is Finish.DONE:
                level = QUALITY_LEVELS[verdict.quality]
            numbers = comparison_lines(last.document, None)
            parts = (last.message, "" if verdict is None else str(verdict), *numbers, last.folder)
            text = "\n".join(part for part in parts if part)
            self._bar.show_message(level, f"{last.name} {last.finish.value}", text)
