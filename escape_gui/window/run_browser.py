"""Browser of the finished runs: load a matrix into the loop, replay a run, open its folder."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from PySide6.QtCore import Signal
from PySide6.QtWidgets import QFileDialog, QPushButton, QWidget

from escape_gui.client.availability import reason_no_change
from escape_gui.client.session import Session
from escape_gui.views.run_list import COLUMNS, RunSummary, read_runs
from escape_gui.widgets.controls import set_available
from escape_gui.window.browser import FolderBrowser
from escape_hw.remote.state import ProductEntry


class RunBrowser(FolderBrowser[RunSummary]):
    """Table of the runs in the run folder, the newest first."""

    #: A run folder or product to replay.
    replay_requested = Signal(object)
    #: A matrix was loaded into the server, as its product.
    matrix_loaded = Signal(object)
    TITLE = "Runs and matrices"
    ROWS = "runs"
    FILTERED_BY = "date, run, system, method, quality"
    COLUMNS = COLUMNS
    SIZE = (1000, 560)

    def __init__(self, window: QWidget, session: Session) -> None:
        super().__init__(window, session)
        self.table.itemDoubleClicked.connect(lambda _: self.load_selected())
        self.load_button, self.replay_button = QPushButton("Load matrix into the loop"), QPushButton("Replay")
        self.file_button = QPushButton("Load a file…")
        self._add_buttons(
            (self.load_button, self.load_selected),
            (self.replay_button, self._replay_selected),
            (self.folder_button, self._open_folder),
            (self.file_button, self._ask_file),
        )

    @staticmethod
    def _find(folder: Path) -> list[RunSummary]:
        return list(read_runs(folder))

    @staticmethod
    def _cells(entry: RunSummary) -> Sequence[tuple[str, float | str]]:
        return entry.cells

    @staticmethod
    def _details(entry: RunSummary) -> str:
        return entry.verdict

    def update_buttons(self) -> None:
        run, why = self.selected, reason_no_change(self._session.request_context)
        choose = "" if run is not None else "select a run"
        no_matrix = "this run has no matrix" if run is not None and run.matrix is None else ""
        tip = "Add the matrix of this run to those that the loop can use; the loop does not change."
        set_available(self.load_button, tip, why or choose or no_matrix)
        set_available(self.replay_button, "Show this run in the panels.", choose)
        set_available(self.folder_button, "Show the files of this run.", choose)
        set_available(self.file_button, "Add a matrix from a file to those that the loop can use.", why)

    def _describe_selection(self) -> str:
        if (run := self.selected) is not None:
            return run.verdict
        if self.table.rowCount() == 0:
            return f"No finished run in {self._runs}."
        return "Select a run. Click a heading to sort."

    # ------------------------------------------------------------ actions
    def load_selected(self) -> None:
        """Load the matrix of the selected run into the server."""
        run = self.selected
        if run is not None and run.matrix is not None and self.load_button.isEnabled():
            self._load(run.matrix, run.name)

    def _ask_file(self) -> None:
        start = str(self._runs)
        chosen, _ = QFileDialog.getOpenFileName(self, "Load a matrix", start, "Products (*.fits)")
        if chosen:
            self._load(Path(chosen), None)

    def _load(self, path: Path, name: str | None) -> None:
        self.message.setText("Loading…")
        self._session.ask(
            "load the matrix",
            lambda server: server.load_product(path, name),
            self._on_loaded,
            self.message.setText,
        )

    def _on_loaded(self, product: ProductEntry) -> None:
        self.message.setText(f"Loaded as '{product.name}': {product.summary}")
        self.matrix_loaded.emit(product)

    def _replay_selected(self) -> None:
        if (run := self.selected) is not None:
            self.replay_requested.emit(run.folder)
            self.hide()
