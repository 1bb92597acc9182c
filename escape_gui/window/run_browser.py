"""Browser of the finished runs: load a matrix into the loop, replay a run, open its folder."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from PySide6.QtCore import Qt, QUrl, Signal
from PySide6.QtGui import QDesktopServices
from PySide6.QtWidgets import (
    QDialog,
    QFileDialog,
    QLineEdit,
    QPushButton,
    QTableWidget,
    QWidget,
)

from escape_gui.client.availability import reason_no_change
from escape_gui.client.session import Session, runs_folder
from escape_gui.views.run_list import COLUMNS, RunSummary, read_runs
from escape_gui.widgets.browser_table import Cell, browser_table
from escape_gui.widgets.controls import column, row, set_available, text_label
from escape_hw.remote.state import ProductEntry

_SUMMARY = Qt.ItemDataRole.UserRole


class RunBrowser(QDialog):
    """Table of the runs in the run folder, the newest first."""

    #: A run folder or product to replay.
    replay_requested = Signal(object)
    #: A matrix was loaded into the server, as its product.
    matrix_loaded = Signal(object)
    _listed = Signal(object)

    def __init__(self, window: QWidget, session: Session) -> None:
        super().__init__(window)
        self._window, self._session = window, session
        self.setWindowTitle("Runs and matrices")
        self.filter = QLineEdit()
        self.filter.setPlaceholderText("Filter: words of date, run, system, method, quality")
        self.filter.setClearButtonEnabled(True)
        self.filter.setAccessibleName("Filter the runs")
        self.filter.textChanged.connect(self._apply_filter)
        self.table = self._make_table()
        self.verdict = text_label()
        self.load_button, self.replay_button = QPushButton("Load matrix into the loop"), QPushButton("Replay")
        self.folder_button, self.file_button = QPushButton("Open folder"), QPushButton("Load a file…")
        close = QPushButton("Close")
        for button, handler in (
            (self.load_button, self.load_selected), (self.replay_button, self._replay_selected),
            (self.folder_button, self._open_folder), (self.file_button, self._ask_file), (close, self.reject),
        ):  # fmt: skip
            button.setAutoDefault(False)
            button.clicked.connect(handler)
        buttons = row(self.load_button, self.replay_button, self.folder_button, self.file_button, None, close)
        column(self.filter, (self.table, 1), self.verdict, buttons, parent=self).setContentsMargins(
            12, 12, 12, 12
        )
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="escape-runs")
        self._listed.connect(self._show_runs, Qt.ConnectionType.QueuedConnection)
        self._enable()

    def _make_table(self) -> QTableWidget:
        table = browser_table(COLUMNS, "Runs")
        table.itemSelectionChanged.connect(self._enable)
        table.itemDoubleClicked.connect(lambda _: self.load_selected())
        return table

    # ------------------------------------------------------------ list
    def open_list(self) -> None:
        """Show the dialog and read the run folder again."""
        self.verdict.setText("Reading the run folder…")
        future = self._pool.submit(lambda folder: list(read_runs(folder)), runs_folder(self._session))
        future.add_done_callback(self._listed.emit)
        window = self._window
        self.resize(min(1000, window.width() - 32), min(560, window.height() - 64))
        self.show()
        self.raise_()
        self.filter.setFocus()

    def _show_runs(self, future: Future[list[RunSummary]]) -> None:
        runs = future.result()
        self.table.setSortingEnabled(False)
        self.table.setRowCount(len(runs))
        for line, run in enumerate(runs):
            quality = -1 if run.quality is None else run.quality
            values: tuple[float | str, ...]
            values = (run.date, run.name, run.system, run.method, run.frames, quality, run.size_mb)
            for k, text in enumerate(run.cells):
                cell = Cell(text, values[k])
                cell.setData(_SUMMARY, run)
                cell.setToolTip(run.verdict)
                self.table.setItem(line, k, cell)
        self.table.setSortingEnabled(True)
        self.table.sortItems(0, Qt.SortOrder.DescendingOrder)
        self._apply_filter()
        self._enable()

    def _apply_filter(self) -> None:
        for line in range(self.table.rowCount()):
            self.table.setRowHidden(line, not self._run(line).matches(self.filter.text()))

    def _run(self, line: int) -> RunSummary:
        item = self.table.item(line, 0)
        assert item is not None
        run: RunSummary = item.data(_SUMMARY)
        return run

    @property
    def selected(self) -> RunSummary | None:
        """The selected run, unless the filter hides it."""
        line = self.table.currentRow()
        chosen = line >= 0 and self.table.selectedItems() and not self.table.isRowHidden(line)
        return self._run(line) if chosen else None

    def _enable(self) -> None:
        run, why = self.selected, reason_no_change(self._session.request_context)
        choose = "" if run is not None else "select a run"
        no_matrix = "this run has no matrix" if run is not None and run.matrix is None else ""
        tip = "Add the matrix of this run to those that the loop can use; the loop does not change."
        set_available(self.load_button, tip, why or choose or no_matrix)
        set_available(self.replay_button, "Show this run in the panels.", choose)
        set_available(self.folder_button, "Show the files of this run.", choose)
        set_available(self.file_button, "Add a matrix from a file to those that the loop can use.", why)
        if run is not None:
            self.verdict.setText(run.verdict)
        elif self.table.rowCount() == 0:
            self.verdict.setText(f"No finished run in {runs_folder(self._session)}.")
        else:
            self.verdict.setText("Select a run. Click a heading to sort.")

    # ------------------------------------------------------------ actions
    def load_selected(self) -> None:
        """Load the matrix of the selected run into the server."""
        run = self.selected
        if run is not None and run.matrix is not None and self.load_button.isEnabled():
            self._load(run.matrix, run.name)

    def _ask_file(self) -> None:
        start = str(runs_folder(self._session))
        chosen, _ = QFileDialog.getOpenFileName(self, "Load a matrix", start, "Products (*.fits)")
        if chosen:
            self._load(Path(chosen), None)

    def _load(self, path: Path, name: str | None) -> None:
        self.verdict.setText("Loading…")
        self._session.ask(
            "load the matrix",
            lambda server: server.load_product(path, name),
            self._on_loaded,
            self.verdict.setText,
        )

    def _on_loaded(self, product: ProductEntry) -> None:
        self.verdict.setText(f"Loaded as '{product.name}': {product.summary}")
        self.matrix_loaded.emit(product)

    def _replay_selected(self) -> None:
        if (run := self.selected) is not None:
            self.replay_requested.emit(run.folder)
            self.hide()

    def _open_folder(self) -> None:
        if (run := self.selected) is not None:
            QDesktopServices.openUrl(QUrl.fromLocalFile(str(run.folder)))

    def shut_down(self) -> None:
        """Stop the thread; called when the window is closed."""
        self.hide()
        self._pool.shutdown(wait=True, cancel_futures=True)
