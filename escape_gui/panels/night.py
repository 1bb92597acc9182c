"""Log of the night: notes of the operator beside events, with export."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from datetime import UTC, datetime
from html import escape
from pathlib import Path
from typing import ClassVar

from PySide6.QtWidgets import QComboBox, QFileDialog, QLineEdit, QPushButton

from escape_gui.client.availability import reason_no_request
from escape_gui.client.session import runs_folder
from escape_gui.panels.base import Context, Panel
from escape_gui.widgets.controls import LogText, row, set_available, text_label
from escape_gui.widgets.inputs import ignore_wheel_without_focus
from escape_hw.io.night_log import MAX_TEXT, NightEntry, night_of
from escape_hw.remote.source import DataSource

#: Entries shown; the file in the run folder has all of them.
MAX_ENTRIES = 5000
#: Kinds of entries by the choice of the filter.
FILTERS: dict[str, tuple[str, ...]] = {
    "All entries": ("note", "event", "fault", "alarm"),
    "Notes": ("note",),
    "Faults and alarms": ("fault", "alarm"),
}
_COLOURS = {"note": "accent", "fault": "bad", "alarm": "bad"}
_WORDS = {"note": "NOTE", "fault": "FAULT", "alarm": "ALARM"}


class NightPanel(Panel):
    """Notes and events of the night, oldest first, and a field for a new note."""

    name: ClassVar[str] = "night"
    title: ClassVar[str] = "Night log"
    help: ClassVar[str] = (
        "Notes and events of the night: runs, faults, alarms, closures of the loop. Type a note and press "
        "Enter. The server keeps the log, also while no window is open, in the folder of the night's runs; "
        "'escape night-log' prints it. Export writes it as a page with figures of Strehl ratio, seeing, "
        "registration and optical gains."
    )

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self.note = QLineEdit()
        self.note.setPlaceholderText("Note for the night log")
        self.note.setMaxLength(MAX_TEXT)
        self.note.setAccessibleName("Note for the night log")
        self.note.returnPressed.connect(self.add_note)
        self.add_button = QPushButton("Add")
        self.add_button.clicked.connect(self.add_note)
        self.filter = QComboBox()
        ignore_wheel_without_focus(self.filter)
        self.filter.addItems(list(FILTERS))
        self.filter.setAccessibleName("Entries to show")
        self.filter.currentIndexChanged.connect(self._refilter)
        self.export_button = QPushButton("Export…")
        self.export_button.setToolTip("Write the log of this night as HTML or Markdown, with figures")
        self.export_button.clicked.connect(self._ask_export)
        self.text = LogText("Entries of the night log", MAX_ENTRIES)
        self.message = text_label()
        self.message.hide()
        self.body.addLayout(row((self.note, 1), self.add_button))
        self.body.addWidget(self.text, 1)
        self.body.addWidget(self.message)
        self.body.addLayout(row(self.filter, None, self.export_button))
        self.setFocusProxy(self.note)
        self._entries: deque[NightEntry] = deque(maxlen=MAX_ENTRIES)
        self._number = -1
        self.apply_theme()

    # ------------------------------------------------------------ notes
    def add_note(self) -> None:
        """Send the note; the field is cleared when the server has it."""
        text = self.note.text().strip()
        if text and self.note.isEnabled():
            self.note.setEnabled(False)
            self.context.session.ask(
                "add the note", lambda server: server.add_note(text), self._on_added, self._on_refused
            )

    def _on_added(self, entry: NightEntry) -> None:
        self.note.clear()
        self.note.setEnabled(True)
        self.note.setFocus()

    def _on_refused(self, reason: str) -> None:
        self.note.setEnabled(True)
        self._show_message(f"The note is not in the log: {reason}")

    # ------------------------------------------------------------ entries
    def tick(self, source: DataSource) -> None:
        reason = reason_no_request(self.context.session.request_context)
        set_available(self.add_button, "Add the note to the log (Enter).", reason)
        new = source.night_after(self._number)
        if new:
            self._number = new[-1].number
            entries = [entry for entry in new if entry.kind != "sample"]
            self._entries.extend(entries)
            self._append(entries)
        self.text.show_newest()

    def _append(self, entries: Sequence[NightEntry]) -> None:
        kinds = FILTERS[self.filter.currentText()]
        for entry in entries:
            if entry.kind in kinds:
                self.text.appendHtml(self._html(entry))

    def _html(self, entry: NightEntry) -> str:
        colours = self.context.theme.colours
        colour = getattr(colours, _COLOURS.get(entry.kind, "text"))
        author = f" {entry.author.partition(' (')[0]}:" if entry.kind == "note" and entry.author else ""
        word = f"<b>{_WORDS[entry.kind]}{escape(author)}</b> " if entry.kind in _WORDS else ""
        text = escape(entry.text.removeprefix("FAULT: ")).replace("\n", "<br>")
        moment = f'<span style="color:{colours.muted}">{entry.time.astimezone():%H:%M:%S}</span>'
        return f'{moment} <span style="color:{colour}">{word}{text}</span>'

    def _refilter(self) -> None:
        self.text.clear()
        self._append(tuple(self._entries))

    def clear(self) -> None:
        self._entries.clear()
        self._number = -1
        self._refilter()

    def apply_theme(self) -> None:
        self.text.setFont(self.context.theme.font(0.95))
        self._refilter()

    # ------------------------------------------------------------ export
    def _ask_export(self) -> None:
        session, night = self.context.session, night_of(datetime.now(UTC))
        folder = runs_folder(session) / night
        start = folder if folder.is_dir() else Path.home()
        chosen, kind = QFileDialog.getSaveFileName(
            self, "Export the night log", str(start / f"night_{session.source.state.system}.html"),
            "Page with figures (*.html);;Markdown with figures (*.md)",
        )  # fmt: skip
        if chosen:
            path = Path(chosen)
            self.export_to(path if path.suffix else path.with_suffix(".md" if ".md" in kind else ".html"))

    def export_to(self, path: Path) -> None:
        """Write the present night into a file, in a worker thread."""
        session, night = self.context.session, night_of(datetime.now(UTC))
        system, runs = session.source.state.system, runs_folder(session)
        tonight = [entry for entry in session.source.night_after(-1) if night_of(entry.time) == night]
        self._show_message("Writing the night log…")
        session.compute(
            lambda: _write(path, system, night, runs, tonight),
            lambda files: self._show_message("Written: " + ", ".join(str(file) for file in files)),
            lambda reason: self._show_message(f"Not written: {reason}"),
        )

    def _show_message(self, text: str) -> None:
        self.message.setText(text)
        self.message.show()


def _write(
    path: Path, system: str, night: str, runs: Path, tonight: Sequence[NightEntry]
) -> tuple[Path, ...]:
    """Write the report of tonight's entries, with the earlier nights that are on this computer."""
    # Imported here: Matplotlib takes half a second, and the window appears before.
    from escape_hw.report.night_log import NightReport, read_nights

    return NightReport(system, night, {**read_nights(runs, system, night), night: tonight}).write(path)
