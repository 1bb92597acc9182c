"""A page of text over the window: keyboard shortcuts, or the help of a panel."""

from __future__ import annotations

from PySide6.QtCore import QEvent, QObject, Qt
from PySide6.QtGui import QKeyEvent
from PySide6.QtWidgets import QFrame, QLabel, QPushButton, QTextBrowser, QWidget

from escape_gui.theme import Theme
from escape_gui.widgets.layouts import column, row


class Overlay(QFrame):
    """Page of text over a window, closed by Escape; the panels below keep updating."""

    def __init__(self, window: QWidget, theme: Theme) -> None:
        super().__init__(window)
        self._window, self._theme = window, theme
        self.setObjectName("overlay")
        self._title = QLabel()
        self._text = QTextBrowser()
        self._text.setOpenExternalLinks(True)
        close_button = QPushButton("Close (Esc)")
        close_button.clicked.connect(self.hide)
        head = row(self._title, None, close_button)
        column(head, self._text, parent=self).setContentsMargins(16, 12, 16, 16)
        window.installEventFilter(self)
        theme.changed.connect(self._apply_theme)
        self._apply_theme()
        self.hide()

    def open(self, title: str, text: str, *, markdown: bool = False) -> None:
        self._title.setText(title)
        self.setAccessibleName(title)
        if markdown:
            self._text.setMarkdown(text)
        else:
            self._text.setHtml(text)
        self._place()
        self.show()
        self.raise_()
        self._text.setFocus()

    @property
    def page(self) -> str:
        """The text shown, without markup."""
        return self._text.toPlainText()

    def _place(self) -> None:
        width = min(self._theme.pixels(860), self._window.width() - 48)
        height = min(self._theme.pixels(640), self._window.height() - 96)
        self.setGeometry(
            (self._window.width() - width) // 2, (self._window.height() - height) // 2, width, height
        )

    def _apply_theme(self) -> None:
        colours = self._theme.colours
        self._title.setFont(self._theme.font(1.3, bold=True))
        self.setStyleSheet(
            f"#overlay {{ background: {colours.panel}; border: 1px solid {colours.accent};"
            " border-radius: 8px; }"
        )

    def keyPressEvent(self, event: QKeyEvent) -> None:
        if event.key() == Qt.Key.Key_Escape:
            self.hide()
        else:
            super().keyPressEvent(event)

    def eventFilter(self, watched: QObject, event: QEvent) -> bool:
        if event.type() is QEvent.Type.Resize and self.isVisible():
            self._place()
        return False
