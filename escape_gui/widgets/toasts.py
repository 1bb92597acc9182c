"""Short notes in the status bar: a run has ended, a fault, a refusal. They cover nothing."""

from __future__ import annotations

from PySide6.QtCore import Qt, QTimer
from PySide6.QtGui import QResizeEvent
from PySide6.QtWidgets import QFrame, QHBoxLayout, QLabel, QSizePolicy, QToolButton, QWidget

from escape_gui.theme import Theme
from escape_gui.widgets.status_pill import Level, StatusPill

#: How long a note stays; one about something bad stays until it is closed.
SHOWN_MS = 6000
_MOST = 4


class Toast(QFrame):
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
        pill = StatusPill(theme)
        pill.show_condition(level, title)
        self.shut = QToolButton()
        self.shut.setObjectName("quiet")
        self.shut.setText("×")
        self.shut.setAccessibleName("Close this note")
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
        row.addWidget(self.shut)
        self.setToolTip(f"{title}\n{text}".strip())
        self.setAccessibleName(f"{title}: {text}")

    def resizeEvent(self, event: QResizeEvent) -> None:
        """Cut the words where the room ends."""
        super().resizeEvent(event)
        metrics = self._words.fontMetrics()
        self._words.setText(metrics.elidedText(self._line, Qt.TextElideMode.ElideRight, self._words.width()))


class Toasts(QWidget):
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
        self.notes: list[Toast] = []
        # Room for a note is always kept, so that no panel moves when one comes.
        self.setMinimumHeight(self._height())
        theme.changed.connect(lambda: self.setMinimumHeight(self._height()))
        self._show_newest()

    def tell(self, level: Level, title: str, text: str, *, stays: bool | None = None) -> None:
        """Show a note until its time is over, or until it is closed; the oldest goes when there are many."""
        while len(self.notes) >= _MOST:
            self._drop(self.notes[0])
        note = Toast(self._theme, level, title, text)
        note.shut.clicked.connect(lambda: self._drop(note))
        self.notes.append(note)
        self._row.insertWidget(0, note, 1)
        if not (level is Level.BAD if stays is None else stays):
            timer = QTimer(note)
            timer.setSingleShot(True)
            timer.timeout.connect(lambda: self._drop(note))
            timer.start(SHOWN_MS)
        self._show_newest()

    def _drop(self, note: Toast) -> None:
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
