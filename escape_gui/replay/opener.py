"""Opens products and run folders: by the menu, by drag and drop, by the command line."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING

from PySide6.QtCore import QEvent, QObject, Qt, Signal
from PySide6.QtGui import QDropEvent
from PySide6.QtWidgets import QFileDialog

from escape_gui.replay.player import PlaybackBar
from escape_gui.replay.source import ReplaySource
from escape_gui.widgets.controls.status_indicator import Level
from escape_hw.errors import EscapeError

if TYPE_CHECKING:
    from escape_gui.main_window import MainWindow


#: Where a recording is looked at.
REPLAY_WORKSPACE = "calibrate"


class RecordingOpener(QObject):
    """Takes recordings into a window.

    A window on a bench keeps its bench, whose safety buttons must go on working: a recording opened
    there gets a window of its own.

    Parameters
    ----------
    window
        Where recordings are shown, and which files may be dropped on.
    make
        Makes another window.
    """

    _source_read = Signal(object)

    def __init__(self, window: MainWindow, make_window: Callable[[], MainWindow]) -> None:
        super().__init__(window)
        self._window, self._make_window = window, make_window
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="escape-replay")
        self.replay_windows: list[MainWindow] = []
        self.playback_bar = PlaybackBar(window.context.session)
        window.addToolBar(Qt.ToolBarArea.BottomToolBarArea, self.playback_bar)
        window.setAcceptDrops(True)
        window.installEventFilter(self)
        self._source_read.connect(self._on_source_read, Qt.ConnectionType.QueuedConnection)

    def ask_product(self) -> None:
        """Ask for a product, and show it."""
        chosen, _ = QFileDialog.getOpenFileName(self._window, "Open a product", "", "Products (*.fits)")
        if chosen:
            self.open(Path(chosen))

    def ask_run(self) -> None:
        """Ask for the folder of a run, and show it."""
        chosen = QFileDialog.getExistingDirectory(self._window, "Open the folder of a run")
        if chosen:
            self.open(Path(chosen))

    def open(self, path: Path) -> None:
        """Read a product or a run folder beside the window's thread, then show it."""
        future = self._pool.submit(ReplaySource, path)
        future.add_done_callback(self._source_read.emit)

    def _on_source_read(self, future: Future[ReplaySource]) -> None:
        try:
            source = future.result()
        except EscapeError as error:
            self._window.notifications.show_message(Level.ERROR, "Cannot be opened", str(error))
            return
        self._show(source)

    def _show(self, source: ReplaySource) -> None:
        session = self._window.context.session
        if session.requests is None:
            session.set_source(source, None)
            self._window.show_workspace(REPLAY_WORKSPACE)
            return
        other = self._make_window()
        self.replay_windows.append(other)
        other.context.session.set_source(source, None)
        other.show_workspace(REPLAY_WORKSPACE)
        other.setWindowTitle(f"ESCAPE · {source.path.name}")
        other.update_timer.start()
        other.show()

    def eventFilter(self, watched: QObject, event: QEvent) -> bool:
        """Products and run folders may be dropped on the window."""
        if event.type() in (QEvent.Type.DragEnter, QEvent.Type.Drop) and isinstance(event, QDropEvent):
            paths = [Path(url.toLocalFile()) for url in event.mimeData().urls() if url.isLocalFile()]
            if paths and all(is_recording(path) for path in paths):
                event.acceptProposedAction()
                if event.type() == QEvent.Type.Drop:
                    self.open(paths[0])
                return True
        return super().eventFilter(watched, event)

    def close(self) -> None:
        """End the thread, and close the windows that were opened from here."""
        self._pool.shutdown(wait=True, cancel_futures=True)
        for other in self.replay_windows:
            other.close()
            other.context.session.close()
            other.deleteLater()
        self.replay_windows.clear()


def is_recording(path: Path) -> bool:
    """Whether a path may be a product or the folder of a run."""
    return path.is_dir() or path.suffix.lower() == ".fits"
