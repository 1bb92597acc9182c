"""Browser of the recordings of telemetry: open in the panel, show the folder, delete."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from PySide6.QtCore import Signal
from PySide6.QtWidgets import QMessageBox, QPushButton, QWidget

from escape_gui.client.session import Session
from escape_gui.views.telemetry import size_text
from escape_gui.widgets.controls import set_available
from escape_gui.window.browser import FolderBrowser
from escape_hw.io.run_folder import run_time

if TYPE_CHECKING:
    from escape_hw.runtime.session.recordings import RecordingSummary


class RecordingBrowser(FolderBrowser["RecordingSummary"]):
    """Table of the recordings in the run folder, the newest first."""

    #: The folder of a recording to analyse.
    opened = Signal(object)
    TITLE = "Recordings of telemetry"
    ROWS = "recordings"
    FILTERED_BY = "date, system, loop, streams"
    COLUMNS = ("Date", "System", "Loop", "Frames", "Duration", "Size", "Streams")
    SIZE = (900, 480)

    def __init__(self, window: QWidget, session: Session) -> None:
        super().__init__(window, session)
        self.table.itemDoubleClicked.connect(lambda _: self.open_selected())
        self.open_button, self.delete_button = QPushButton("Open"), QPushButton("Delete…")
        #: Open question before a deletion.
        self.question: QMessageBox | None = None
        self._add_buttons(
            (self.open_button, self.open_selected),
            (self.folder_button, self._open_folder),
            (self.delete_button, self._ask_delete),
        )

    @staticmethod
    def _find(folder: Path) -> list[RecordingSummary]:
        # Imported here, as in _remove: SciPy's filters take half a second, and the window appears before.
        from escape_hw.runtime.session.recordings import find_recordings

        return list(find_recordings(folder))

    @staticmethod
    def _cells(entry: RecordingSummary) -> Sequence[tuple[str, float | str]]:
        about = entry.description
        date = f"{entry.folder.parent.name} {run_time(entry.folder)}"
        loop = f"gain {about.gain:g}" if about.loop_closed else ("open" if about.started_utc else "")
        system = f"{about.system} (simulated)" if about.system and about.simulated else about.system
        streams = ", ".join(entry.streams)
        return [
            (date, date), (system, system), (loop, loop), (f"{entry.frames:,}", entry.frames),
            (f"{entry.seconds:,.1f} s" if entry.seconds else "", entry.seconds),
            (size_text(entry.size), entry.size), (streams, streams),
        ]  # fmt: skip

    def update_buttons(self) -> None:
        one, recording = self.selected, self._session.source.state.recording
        choose = "" if one is not None else "select a recording"
        goes_on = one is not None and recording.recording and Path(recording.path) == one.folder
        set_available(self.open_button, "Show its analysis in the panel Telemetry.", choose)
        set_available(self.folder_button, "Show its files.", choose)
        set_available(
            self.delete_button, "Delete its files, after a question.",
            choose or ("it is being recorded" if goes_on else ""),
        )  # fmt: skip

    def _describe_selection(self) -> str:
        if (one := self.selected) is not None:
            return str(one.folder)
        if not (recordings := self._entries()):
            return f"No recording in {self._runs}."
        return f"{len(recordings)} recordings, {size_text(sum(other.size for other in recordings))}"

    # ------------------------------------------------------------ actions
    def open_selected(self) -> None:
        """Analyse the selected recording."""
        if (one := self.selected) is not None:
            self.opened.emit(one.folder)
            self.hide()

    def _ask_delete(self) -> None:
        one = self.selected
        if one is None or self.question is not None:
            return
        question = QMessageBox(
            QMessageBox.Icon.Warning, "Delete the recording?",
            f"Delete {one.folder.name} of {one.folder.parent.name} ({size_text(one.size)})?\n"
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


def _remove(folder: Path) -> None:
    from escape_hw.runtime.session.recordings import delete_recording

    delete_recording(folder)
