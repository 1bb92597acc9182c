"""Browser of the recordings of telemetry: open in the panel, show the folder, delete."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from PySide6.QtCore import Qt, QUrl, Signal
from PySide6.QtGui import QDesktopServices
from PySide6.QtWidgets import QDialog, QLineEdit, QMessageBox, QPushButton, QWidget

from escape_gui.client.session import Session, runs_folder
from escape_gui.widgets.browser_table import Cell, browser_table
from escape_gui.widgets.controls import column, row, set_available, text_label

if TYPE_CHECKING:
    from escape_hw.runtime.session.recordings import RecordingSummary

COLUMNS = ("Date", "System", "Loop", "Frames", "Duration", "Size", "Streams")
_SUMMARY = Qt.ItemDataRole.UserRole


class RecordingBrowser(QDialog):
    """Table of the recordings in the run folder, the newest first."""

    #: The folder of a recording to analyse.
    opened = Signal(object)

    def __init__(self, window: QWidget, session: Session) -> None:
        super().__init__(window)
        self._window, self._session = window, session
        self.setWindowTitle("Recordings of telemetry")
        self.filter = QLineEdit()
        self.filter.setPlaceholderText("Filter: words of date, system, loop, streams")
        self.filter.setClearButtonEnabled(True)
        self.filter.setAccessibleName("Filter the recordings")
        self.filter.textChanged.connect(self._apply_filter)
        self.table = browser_table(COLUMNS, "Recordings")
        self.table.itemSelectionChanged.connect(self._enable)
        self.table.itemDoubleClicked.connect(lambda _: self.open_selected())
        self.message = text_label()
        self.open_button, self.folder_button = QPushButton("Open"), QPushButton("Open folder")
        self.delete_button, close = QPushButton("Delete…"), QPushButton("Close")
        for button, handler in (
            (self.open_button, self.open_selected), (self.folder_button, self._open_folder),
            (self.delete_button, self._ask_delete), (close, self.reject),
        ):  # fmt: skip
            button.setAutoDefault(False)
            button.clicked.connect(handler)
        buttons = row(self.open_button, self.folder_button, self.delete_button, None, close)
        layout = column(self.filter, (self.table, 1), self.message, buttons, parent=self)
        layout.setContentsMargins(12, 12, 12, 12)
        #: Open question before a deletion.
        self.question: QMessageBox | None = None
        self._enable()

    # ------------------------------------------------------------ list
    def open_list(self) -> None:
        """Show the dialog and read the run folder again."""
        window = self._window
        self.resize(min(900, window.width() - 32), min(480, window.height() - 64))
        self.show()
        self.raise_()
        self.filter.setFocus()
        self._read()

    def _read(self) -> None:
        self.message.setText("Reading the run folder…")
        folder = runs_folder(self._session)
        self._session.compute(lambda: _find(folder), self.show_recordings, self.message.setText)

    def show_recordings(self, recordings: list[RecordingSummary]) -> None:
        """Fill the table."""
        self.table.setSortingEnabled(False)
        self.table.setRowCount(len(recordings))
        for line, one in enumerate(recordings):
            for k, (text, value) in enumerate(_cells(one)):
                cell = Cell(text, value)
                cell.setData(_SUMMARY, one)
                self.table.setItem(line, k, cell)
        self.table.setSortingEnabled(True)
        self.table.sortItems(0, Qt.SortOrder.DescendingOrder)
        self._apply_filter()
        self._enable()

    def _apply_filter(self) -> None:
        words = self.filter.text().lower().split()
        for line in range(self.table.rowCount()):
            items = (self.table.item(line, k) for k in range(len(COLUMNS)))
            text = " ".join(item.text() for item in items if item is not None).lower()
            self.table.setRowHidden(line, not all(word in text for word in words))
        self._enable()

    @property
    def selected(self) -> RecordingSummary | None:
        """The selected recording, unless the filter hides it."""
        line = self.table.currentRow()
        item = self.table.item(line, 0) if line >= 0 else None
        if item is None or not self.table.selectedItems() or self.table.isRowHidden(line):
            return None
        summary: RecordingSummary = item.data(_SUMMARY)
        return summary

    def _enable(self) -> None:
        one, recording = self.selected, self._session.source.state.recording
        choose = "" if one is not None else "select a recording"
        goes_on = one is not None and recording.recording and Path(recording.path) == one.folder
        set_available(self.open_button, "Show its analysis in the panel Telemetry.", choose)
        set_available(self.folder_button, "Show its files.", choose)
        set_available(
            self.delete_button, "Delete its files, after a question.",
            choose or ("it is being recorded" if goes_on else ""),
        )  # fmt: skip
        if one is not None:
            self.message.setText(str(one.folder))
        elif self.table.rowCount() == 0:
            self.message.setText(f"No recording in {runs_folder(self._session)}.")
        else:
            total = sum(self._size(line) for line in range(self.table.rowCount()))
            self.message.setText(f"{self.table.rowCount()} recordings, {_size_text(total)}")

    def _size(self, line: int) -> int:
        item = self.table.item(line, 0)
        return 0 if item is None else int(item.data(_SUMMARY).size)

    # ------------------------------------------------------------ actions
    def open_selected(self) -> None:
        """Analyse the selected recording."""
        if (one := self.selected) is not None:
            self.opened.emit(one.folder)
            self.hide()

    def _open_folder(self) -> None:
        if (one := self.selected) is not None:
            QDesktopServices.openUrl(QUrl.fromLocalFile(str(one.folder)))

    def _ask_delete(self) -> None:
        one = self.selected
        if one is None or self.question is not None:
            return
        question = QMessageBox(
            QMessageBox.Icon.Warning, "Delete the recording?",
            f"Delete {one.folder.name} of {one.folder.parent.name} ({_size_text(one.size)})?\n"
            "It cannot be restored.",
            QMessageBox.StandardButton.Cancel, self,
        )  # fmt: skip
        delete = question.addButton("Delete", QMessageBox.ButtonRole.DestructiveRole)
        question.setDefaultButton(QMessageBox.StandardButton.Cancel)
        delete.clicked.connect(lambda: self._delete(one.folder))
        question.finished.connect(self._forget_question)
        self.question = question
        question.open()

    def _forget_question(self) -> None:
        if self.question is not None:
            self.question.deleteLater()
            self.question = None

    def _delete(self, folder: Path) -> None:
        self._session.compute(lambda: _remove(folder), lambda _: self._read(), self.message.setText)


def _find(runs: Path) -> list[RecordingSummary]:
    # Imported here, as in _remove: SciPy's filters take half a second, and the window appears before.
    from escape_hw.runtime.session.recordings import find_recordings

    return list(find_recordings(runs))


def _remove(folder: Path) -> None:
    from escape_hw.runtime.session.recordings import delete_recording

    delete_recording(folder)


def _cells(one: RecordingSummary) -> list[tuple[str, float | str]]:
    """Text and value for sorting of every column."""
    name, about = one.folder.name, one.description
    date = f"{one.folder.parent.name} {name[:2]}:{name[2:4]}:{name[4:6]}"
    loop = f"gain {about.gain:g}" if about.loop_closed else ("open" if about.started_utc else "")
    system = f"{about.system} (simulated)" if about.system and about.simulated else about.system
    streams = ", ".join(one.streams)
    return [
        (date, date), (system, system), (loop, loop), (f"{one.frames:,}", one.frames),
        (f"{one.seconds:,.1f} s" if one.seconds else "", one.seconds),
        (_size_text(one.size), one.size), (streams, streams),
    ]  # fmt: skip


def _size_text(size: float) -> str:
    return f"{size / 1e9:,.2f} GB" if size >= 1e9 else f"{size / 1e6:,.1f} MB"
