"""Short notes at the corner of the window: a run has ended, a fault, a refusal. None asks for a click."""

from __future__ import annotations

from PySide6.QtCore import QEvent, QObject, Qt, QTimer
from PySide6.QtWidgets import QFrame, QHBoxLayout, QLabel, QToolButton, QVBoxLayout, QWidget

from escape_gui.theme import Theme
from escape_gui.widgets.status_pill import Level, StatusPill

#: How long a note stays; one about something bad stays until it is closed.
SHOWN_MS = 8000
_MOST = 4


class Toast(QFrame):
    """One note.

    Parameters
    ----------
    theme
        Look.
    level, title, text
        What it says.
    """

    def __init__(self, theme: Theme, level: Level, title: str, text: str) -> None:
        super().__init__()
        colours = theme.colours
        edge = getattr(colours, level.value)
        self.setObjectName("toast")
        self.setStyleSheet(
            f"#toast {{ background: {colours.button}; border: 1px solid {edge}; border-radius: 6px; }}"
        )
        self.title, self.text, self.level = title, text, level
        pill = StatusPill(theme)
        pill.show_condition(level, title)
        self.shut = QToolButton()
        self.shut.setObjectName("quiet")
        self.shut.setText("×")
        self.shut.setAccessibleName("Close this note")
        words = QLabel(text)
        words.setWordWrap(True)
        words.setTextInteractionFlags(Qt.TextInteractionFlag.TextSelectableByMouse)
        head = QHBoxLayout()
        head.addWidget(pill)
        head.addStretch()
        head.addWidget(self.shut)
        column = QVBoxLayout(self)
        column.setContentsMargins(8, 4, 4, 8)
        column.setSpacing(2)
        column.addLayout(head)
        column.addWidget(words)
        self.setAccessibleName(f"{title}: {text}")


class Toasts(QWidget):
    """The notes of a window, newest below.

    Parameters
    ----------
    window
        Over whose lower right corner they lie.
    theme
        Look.
    """

    def __init__(self, window: QWidget, theme: Theme) -> None:
        super().__init__(window)
        self._window, self._theme = window, theme
        self._column = QVBoxLayout(self)
        self._column.setContentsMargins(0, 0, 0, 0)
        self._column.setSpacing(8)
        self.notes: list[Toast] = []
        window.installEventFilter(self)
        self.hide()

    def tell(self, level: Level, title: str, text: str, *, stays: bool | None = None) -> None:
        """Show a note until its time is over, or until it is closed; the oldest goes when there are many."""
        while len(self.notes) >= _MOST:
            self._drop(self.notes[0])
        note = Toast(self._theme, level, title, text)
        note.shut.clicked.connect(lambda: self._drop(note))
        self.notes.append(note)
        self._column.addWidget(note)
        if not (level is Level.BAD if stays is None else stays):
            timer = QTimer(note)
            timer.setSingleShot(True)
            timer.timeout.connect(lambda: self._drop(note))
            timer.start(SHOWN_MS)
        self._place()

    def _drop(self, note: Toast) -> None:
        if note in self.notes:
            self.notes.remove(note)
            self._column.removeWidget(note)
            note.hide()
            note.deleteLater()
            self._place()

    def _place(self) -> None:
        if not self.notes:
            self.hide()
            return
        width = min(self._theme.pixels(380), self._window.width() - 32)
        self.setFixedWidth(width)
        height = max(self._column.heightForWidth(width), self.sizeHint().height())
        self.setGeometry(
            self._window.width() - width - 16, self._window.height() - height - 40, width, height
        )
        self.show()
        self.raise_()

    def eventFilter(self, watched: QObject, event: QEvent) -> bool:
        """Stay in the corner."""
        if event.type() is QEvent.Type.Resize:
            self._place()
        return False
