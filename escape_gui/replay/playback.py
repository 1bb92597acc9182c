"""Opens recorded runs (menu, drag and drop) and plays them step by step."""

from __future__ import annotations

import logging
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from PySide6.QtCore import QEvent, QObject, Qt, QTimer, Signal
from PySide6.QtGui import QDropEvent
from PySide6.QtWidgets import QFileDialog, QLabel, QSlider, QToolBar, QToolButton, QWidget

from escape_gui.client.session import Session, runs_folder
from escape_gui.replay.source import ReplaySource
from escape_hw.errors import EscapeError, ProductError

log = logging.getLogger(__name__)


class RecordingOpener(QObject):
    """Reads recorded runs, chosen in a dialog or dropped on the window, in a worker thread."""

    #: A run or product was read, as :class:`~escape_gui.replay.source.ReplaySource`.
    opened = Signal(object)
    #: Why it could not be read.
    failed = Signal(str)
    _read = Signal(object)

    def __init__(self, window: QWidget, session: Session) -> None:
        super().__init__(window)
        self._window, self._session = window, session
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="escape-replay")
        window.setAcceptDrops(True)
        window.installEventFilter(self)
        self._read.connect(self._on_read, Qt.ConnectionType.QueuedConnection)

    def ask_product(self) -> None:
        chosen, _ = QFileDialog.getOpenFileName(
            self._window, "Open a product", self._folder(), "Products (*.fits)"
        )
        if chosen:
            self.open(Path(chosen))

    def ask_run(self) -> None:
        chosen = QFileDialog.getExistingDirectory(self._window, "Open the folder of a run", self._folder())
        if chosen:
            self.open(Path(chosen))

    def _folder(self) -> str:
        """Folder in which the dialogs open."""
        return str(runs_folder(self._session))

    def open(self, path: Path) -> None:
        """Start to read a product or a run folder; returns at once."""
        self._pool.submit(read_run, path).add_done_callback(self._read.emit)

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


def read_run(path: Path) -> ReplaySource:
    """Read a product or a run folder; EscapeError: it cannot be read, or is damaged."""
    try:
        return ReplaySource(path)
    except EscapeError:
        raise
    except Exception as error:
        log.error("%s cannot be replayed", path, exc_info=error)
        reason = f"{type(error).__name__}: {error}"
        raise ProductError(
            f"{path}: its document is damaged ({reason}); open its products one by one"
        ) from None


def is_recording(path: Path) -> bool:
    """Whether a path may be a product or the folder of a run."""
    return path.is_dir() or path.suffix.lower() == ".fits"


#: Largest number of steps of the slider, and duration of each in playback.
_MAX_STEPS, _STEP_MS = 600, 150


class PlaybackBar(QToolBar):
    """Tool bar that is visible while a recorded run with several steps is open."""

    def __init__(self, session: Session) -> None:
        super().__init__("Replay")
        self.setObjectName("transport")
        self.setMovable(False)
        self._session = session
        self._name_label = QLabel()
        self.slider = QSlider(Qt.Orientation.Horizontal)
        self.slider.setAccessibleName("Position in the recorded run")
        self.slider.setToolTip("Position in the run: iterations, rounds, seconds of tracking.")
        self.slider.valueChanged.connect(self._seek)
        self.play = QToolButton()
        self.play.setText("▶ Play")
        self.play.setCheckable(True)
        self.play.setToolTip("Play the run step by step.")
        self.play.toggled.connect(self._on_play_toggled)
        self.position_label = QLabel()
        for widget in (self._name_label, self.play, self.slider, self.position_label):
            self.addWidget(widget)
        self._timer = QTimer(self)
        self._timer.setInterval(_STEP_MS)
        self._timer.timeout.connect(self._step)
        session.changed.connect(self._on_source_changed)
        self._on_source_changed()

    @property
    def recording(self) -> ReplaySource | None:
        """The recorded run that is open, if any."""
        source = self._session.source
        return source if isinstance(source, ReplaySource) else None

    def _on_source_changed(self) -> None:
        recording = self.recording
        self.play.setChecked(False)
        self.setVisible(recording is not None and recording.steps > 1)
        if recording is not None:
            self._name_label.setText(f"REPLAY of {recording.path.name}  ")
            self.slider.setRange(1, min(recording.steps, _MAX_STEPS))
            self.slider.setValue(self.slider.maximum())
            self._show_position()

    def _seek(self, value: int) -> None:
        if (recording := self.recording) is not None:
            recording.seek(value / self.slider.maximum())
            self._show_position()

    def _show_position(self) -> None:
        if (recording := self.recording) is not None:
            self.position_label.setText(f"  step {recording.step} of {recording.steps}  ")

    def _on_play_toggled(self, on: bool) -> None:
        self.play.setText("⏸ Pause" if on else "▶ Play")
        if on and self.slider.value() == self.slider.maximum():
            self.slider.setValue(1)
        (self._timer.start if on else self._timer.stop)()

    def _step(self) -> None:
        self.slider.setValue(self.slider.value() + 1)
        if self.slider.value() == self.slider.maximum():
            self.play.setChecked(False)
