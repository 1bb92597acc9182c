"""The server's log, with search and filter."""

from __future__ import annotations

from collections import deque
from html import escape
from typing import ClassVar

from PySide6.QtGui import QGuiApplication, QTextCursor
from PySide6.QtWidgets import QComboBox, QLineEdit, QPushButton

from escape_gui.panels.base import Context, Panel
from escape_gui.widgets.controls import LogText, row
from escape_gui.widgets.inputs import ignore_wheel_without_focus
from escape_hw.io.provenance import format_local_time
from escape_hw.remote.source import DataSource
from escape_hw.remote.state import LogLine

#: Number of lines kept; the server's log file has all of them.
MAX_LINES = 5000
LEVELS = ("DEBUG", "INFO", "WARNING", "ERROR", "CRITICAL")
_COLOURS = {"WARNING": "warn", "ERROR": "bad", "CRITICAL": "bad", "DEBUG": "muted"}


class LogPanel(Panel):
    """Log lines, oldest first."""

    name: ClassVar[str] = "log"
    title: ClassVar[str] = "Log"
    help: ClassVar[str] = (
        "The log of the server, newest line last. Type words to show the lines that contain all of them, "
        "choose the minimum level, copy the lines shown. Follows the newest line while scrolled to the end."
    )

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self.search = QLineEdit()
        self.search.setPlaceholderText("Search")
        self.search.setClearButtonEnabled(True)
        self.search.setAccessibleName("Search the log")
        self.search.textChanged.connect(self._refilter)
        self.level = QComboBox()
        ignore_wheel_without_focus(self.level)
        self.level.addItems([level.title() for level in LEVELS])
        self.level.setCurrentIndex(1)
        self.level.setAccessibleName("Minimum level")
        self.level.setToolTip("Show lines of this level and above")
        self.level.currentIndexChanged.connect(self._refilter)
        self.text = LogText("Lines of the log", MAX_LINES)
        self.copy_button = QPushButton("Copy")
        self.copy_button.setToolTip("Copy the lines shown")
        self.copy_button.clicked.connect(lambda: QGuiApplication.clipboard().setText(self.text.toPlainText()))
        self.body.addLayout(row((self.search, 1), self.level, self.copy_button))
        self.body.addWidget(self.text, 1)
        self._lines: deque[LogLine] = deque(maxlen=MAX_LINES)
        self._number = -1
        self._last_shown, self._repeats = ("", ""), 0
        self.apply_theme()

    def tick(self, source: DataSource) -> None:
        new = source.log_after(self._number)
        if new:
            self._number = new[-1].number
            self._lines.extend(new)
            self._append([line for line in new if self._matches(line)])
        self.text.show_newest()

    def _matches(self, line: LogLine) -> bool:
        if line.level in LEVELS and LEVELS.index(line.level) < self.level.currentIndex():
            return False
        text = f"{line.text} {line.logger}".lower()
        return all(word in text for word in self.search.text().lower().split())

    def _append(self, lines: list[LogLine]) -> None:
        """Append lines; equal lines in a row are one line with their number and the newest time."""
        for line in lines:
            same = (line.level, line.text) == self._last_shown
            self._last_shown, self._repeats = (line.level, line.text), self._repeats + 1 if same else 1
            if same:
                cursor = self.text.textCursor()
                cursor.movePosition(QTextCursor.MoveOperation.End)
                cursor.select(QTextCursor.SelectionType.BlockUnderCursor)
                cursor.removeSelectedText()
            self.text.appendHtml(self._html(line, self._repeats))

    def _html(self, line: LogLine, repeats: int) -> str:
        colours = self.context.theme.colours
        colour = getattr(colours, _COLOURS.get(line.level, "text"))
        times = f" (× {repeats})" if repeats > 1 else ""
        moment = escape(format_local_time(line.at_utc))
        level = escape(f"{line.level:<8}").replace(" ", "&nbsp;")
        return (
            f'<span style="color:{colours.muted}">{moment}</span> '
            f'<span style="color:{colour}">{level} {escape(line.text)}{times}</span>'
        )

    def _refilter(self) -> None:
        self.text.clear()
        self._last_shown, self._repeats = ("", ""), 0
        self._append([line for line in self._lines if self._matches(line)])

    def clear(self) -> None:
        self._lines.clear()
        self._number = -1
        self._refilter()

    def apply_theme(self) -> None:
        self.text.setFont(self.context.theme.font(0.9, mono=True))
        self._refilter()
