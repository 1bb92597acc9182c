"""Browser of what the run folder holds: a table with a filter, a line of text and buttons."""

from __future__ import annotations

import abc
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import ClassVar, Generic, Protocol, TypeVar

from PySide6.QtCore import Qt, QUrl
from PySide6.QtGui import QDesktopServices
from PySide6.QtWidgets import QDialog, QLineEdit, QPushButton, QWidget

from escape_gui.client.session import Session, runs_folder
from escape_gui.widgets.browser_table import SortableCell, browser_table
from escape_gui.widgets.controls import column, row, text_label


class _HasFolder(Protocol):
    @property
    def folder(self) -> Path: ...


T = TypeVar("T", bound=_HasFolder)
_ENTRY = Qt.ItemDataRole.UserRole


class FolderBrowser(QDialog, Generic[T]):
    """Table of what a subclass finds in the run folder, the newest first.

    A subclass ends its construction with :meth:`_add_buttons`.
    """

    TITLE: ClassVar[str]
    #: What the rows are called, and what they are filtered by.
    ROWS: ClassVar[str]
    FILTERED_BY: ClassVar[str]
    COLUMNS: ClassVar[Sequence[str]]
    #: Largest width and height on opening, pixels.
    SIZE: ClassVar[tuple[int, int]]

    def __init__(self, window: QWidget, session: Session) -> None:
        super().__init__(window)
        self._window, self._session = window, session
        self.setWindowTitle(self.TITLE)
        self.filter = QLineEdit()
        self.filter.setPlaceholderText(f"Filter: words of {self.FILTERED_BY}")
        self.filter.setClearButtonEnabled(True)
        self.filter.setAccessibleName(f"Filter the {self.ROWS}")
        self.filter.textChanged.connect(self._apply_filter)
        self.table = browser_table(self.COLUMNS, self.ROWS.capitalize())
        self.table.itemSelectionChanged.connect(self._enable)
        self.message = text_label()
        self.folder_button = QPushButton("Open folder")

    def _add_buttons(self, *buttons: tuple[QPushButton, Callable[[], object]]) -> None:
        """Connect the buttons and one that closes the dialog, and lay everything out."""
        close = QPushButton("Close")
        for button, handler in (*buttons, (close, self.reject)):
            button.setAutoDefault(False)
            button.clicked.connect(handler)
        line = row(*(button for button, _ in buttons), None, close)
        layout = column(self.filter, (self.table, 1), self.message, line, parent=self)
        layout.setContentsMargins(12, 12, 12, 12)
        self._enable()

    @staticmethod
    @abc.abstractmethod
    def _find(folder: Path) -> list[T]:
        """What the run folder holds; runs in a worker thread."""

    @staticmethod
    @abc.abstractmethod
    def _cells(entry: T) -> Sequence[tuple[str, float | str]]:
        """Text and value for sorting of every column."""

    @staticmethod
    def _details(entry: T) -> str:
        """Tooltip of a row; its words are filtered by, too."""
        return ""

    @abc.abstractmethod
    def update_buttons(self) -> None:
        """Enable what is possible now; called by the window while the dialog is visible."""

    @abc.abstractmethod
    def _describe_selection(self) -> str:
        """The line below the table."""

    def _enable(self) -> None:
        """Enable the buttons that apply to the selection, and describe it."""
        self.update_buttons()
        self.message.setText(self._describe_selection())

    # ------------------------------------------------------------ list
    def open_list(self) -> None:
        """Show the dialog and read the run folder again."""
        window, (width, height) = self._window, self.SIZE
        self.resize(min(width, window.width() - 32), min(height, window.height() - 64))
        self.show()
        self.raise_()
        self.filter.setFocus()
        self._read()

    @property
    def _runs(self) -> Path:
        return runs_folder(self._session)

    def _read(self) -> None:
        self.message.setText("Reading the run folder…")
        folder = self._runs
        self._session.compute(lambda: self._find(folder), self._fill, self.message.setText)

    def _fill(self, entries: list[T]) -> None:
        self.table.setSortingEnabled(False)
        self.table.setRowCount(len(entries))
        for line, entry in enumerate(entries):
            for k, (text, value) in enumerate(self._cells(entry)):
                cell = SortableCell(text, value)
                cell.setData(_ENTRY, entry)
                cell.setToolTip(self._details(entry))
                self.table.setItem(line, k, cell)
        self.table.setSortingEnabled(True)
        self.table.sortItems(0, Qt.SortOrder.DescendingOrder)
        self._apply_filter()

    def _apply_filter(self) -> None:
        words = self.filter.text().lower().split()
        for line, entry in enumerate(self._entries()):
            text = " ".join((*(text for text, _ in self._cells(entry)), self._details(entry))).lower()
            self.table.setRowHidden(line, not all(word in text for word in words))
        self._enable()

    def _entries(self) -> list[T]:
        """Entries of all rows, from top to bottom."""
        items = (self.table.item(line, 0) for line in range(self.table.rowCount()))
        return [item.data(_ENTRY) for item in items if item is not None]

    @property
    def selected(self) -> T | None:
        """What is selected, unless the filter hides it."""
        line = self.table.currentRow()
        chosen = line >= 0 and self.table.selectedItems() and not self.table.isRowHidden(line)
        return self._entries()[line] if chosen else None

    def _open_folder(self) -> None:
        if (entry := self.selected) is not None:
            QDesktopServices.openUrl(QUrl.fromLocalFile(str(entry.folder)))
