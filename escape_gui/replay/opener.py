"""Opens products and run folders: from the menu, by drag and drop, from the command line."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from PySide6.QtCore import QEvent, QObject, Qt, Signal
from PySide6.QtGui import QDropEvent
from PySide6.QtWidgets import QFileDialog, QWidget

from escape_gui.replay.source import ReplaySource
from escape_hw.errors import EscapeError


class RecordingOpener(QObject):
    """Reads recorded runs, chosen in a dialog or dropped on the window, in a worker thread."""

    #: A run or product was read, as :class:`~escape_gui.replay.source.ReplaySource`.
    opened = Signal(object)
    #: Why it could not be read.
    failed = Signal(str)
    _read = Signal(object)

    def __init__(self, window: QWidget) -> None:
        super().__init__(window)
        self._window = window
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="escape-replay")
        window.setAcceptDrops(True)
        window.installEventFilter(self)
        self._read.connect(self._on_read, Qt.ConnectionType.QueuedConnection)

    def ask_product(self) -> None:
        chosen, _ = QFileDialog.getOpenFileName(self._window, "Open a product", "", "Products (*.fits)")
        if chosen:
            self.open(Path(chosen))

    def ask_run(self) -> None:
        chosen = QFileDialog.getExistingDirectory(self._window, "Open the folder of a run")
        if chosen:
            self.open(Path(chosen))

    def open(self, path: Path) -> None:
        """Start to read a product or a run folder; returns at once."""
        self._pool.submit(ReplaySource, path).add_done_callback(self._read.emit)

    def _on_read(self, future: Future[ReplaySource]) -> None:
        try:
            self.opened.emit(future.result())
        except EscapeError as error:
            self.failed.emit(str(error))

    def eventFilter(self, watched: QObject, event: QEvent) -> bool:
        if event.type() in (QEvent.Type.DragEnter, QEvent.Type.Drop) and isinstance(event, QDropEvent):
            paths = [Path(url.toLocalFile()) for url in event.mimeData().urls() if url.isLocalFile()]
            if paths and all(is_recording(path) for path in paths):
                event.acceptProposedAction()
                if event.type() == QEvent.Type.Drop:
                    self.open(paths[0])
                return True
        return super().eventFilter(watched, event)

    def close(self) -> None:
        self._pool.shutdown(wait=True, cancel_futures=True)


def is_recording(path: Path) -> bool:
    """Whether a path may be a product or the folder of a run."""
    return path.is_dir() or path.suffix.lower() == ".fits"
