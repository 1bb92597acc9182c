"""``escape gui``: creates the application, connects to or starts a server, shows the main window."""

from __future__ import annotations

import logging
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import pyqtgraph
from PySide6.QtCore import QObject, QTimer
from PySide6.QtGui import QIcon
from PySide6.QtWidgets import QApplication

from escape_gui.client.connection import LiveSource, LocalServer, ServerAttachment
from escape_gui.client.session import EmptySource, Session
from escape_gui.main_window import MainWindow
from escape_gui.replay.playback import is_recording, read_run
from escape_gui.replay.source import ReplaySource
from escape_gui.settings import Settings, load_settings, settings_file
from escape_gui.widgets.controls import Level
from escape_gui.window.closing import is_busy
from escape_gui.window.export import save_png
from escape_hw.config.loader import load_system
from escape_hw.errors import ConfigError, EscapeError, ServerGone
from escape_hw.remote.address import find_server, running_servers
from escape_hw.remote.state import Phase
from escape_hw.runtime.host.doctor import missing_qt_libraries

log = logging.getLogger(__name__)
#: System to serve if none is named and no server runs.
DEFAULT_SYSTEM = "razor-shwfs"
#: Delay between a ready engine and the screenshot, milliseconds, and longest wait for the engine, seconds.
_SCREENSHOT_DELAY_MS, _SCREENSHOT_TIMEOUT_S = 4000, 60.0
#: Title of the message without a server; it is closed when one answers.
_NO_SERVER = "No server"
_ICON = Path(__file__).with_name("escape.svg")
#: Niceness of the window's process, so that a loop on the same computer takes precedence.
_NICENESS = 10


def require_display() -> None:
    """Check that a display is available, with a clearer message than Qt's.

    Raises
    ------
    ConfigError
        There is no display, or a library that Qt needs for it is missing.
    """
    if os.environ.get("QT_QPA_PLATFORM") or os.environ.get("WAYLAND_DISPLAY"):
        return
    if not os.environ.get("DISPLAY"):
        raise ConfigError(
            "no display: log in with 'ssh -X', or set QT_QPA_PLATFORM=offscreen for --screenshot without one"
        )
    if missing := missing_qt_libraries():
        raise ConfigError(f"Qt needs libraries for the display: 'apt install {' '.join(missing)}'")


def qt_application() -> QApplication:
    """The Qt application of this process; created on the first call."""
    existing = QApplication.instance()
    qt_app = existing if isinstance(existing, QApplication) else QApplication(sys.argv[:1])
    qt_app.setApplicationName("ESCAPE")
    # The desktop entry of this name has the same icon, where it is installed.
    qt_app.setDesktopFileName("escape")
    qt_app.setWindowIcon(QIcon(str(_ICON)))
    # Antialiased curves take five times as long to draw.
    pyqtgraph.setConfigOptions(imageAxisOrder="row-major", antialias=False)
    return qt_app


class WindowController(QObject):
    """Connects a window to the server at an address, and stops ``local_server`` if the window started one.

    Without an address, the window is connected when its operator chooses a server. ``start_server`` starts
    the server of a system.
    """

    def __init__(
        self,
        window: MainWindow,
        session: Session,
        address: str,
        local_server: LocalServer | None,
        start_server: Callable[[str], LocalServer] = LocalServer,
    ) -> None:
        super().__init__()
        self.window, self.session = window, session
        self.local_server: LocalServer | None = None
        self._live: LiveSource | None = None
        #: Why there is no connection yet; empty while it is being made.
        self.failure = ""
        #: A recorded run on screen when the operator asked for a server, which then takes its place.
        self._left_recording: ReplaySource | None = None
        #: The window is connected, but a recorded run stays on screen.
        self._waits = False
        self.attachment: ServerAttachment | None = None
        self._stopped: list[ServerAttachment] = []
        self._start_server = start_server
        window.connect_dialog.connect_requested.connect(self.connect_to)
        window.connect_dialog.start_requested.connect(self.start_server)
        window.server_banner.button.clicked.connect(self._show_server)
        if address:
            self._attach(address, local_server)

    def connect_to(self, address: str, local_server: LocalServer | None = None) -> None:
        """Disconnect from the present server, which goes on, and connect to another one.

        A recorded run stays on screen until the window is connected.
        """
        if self._waits and self.attachment is not None and address == self.attachment.address:
            self._show_server()
            return
        self._left_recording = self._recording
        if self._left_recording is None:
            self.session.set_source(EmptySource(), None)
        self._stop_waiting()
        if self.attachment is not None:
            # Its thread may wait for a reply; it is joined when the window is closed.
            self.attachment.stop()
            self._stopped.append(self.attachment)
        if self.local_server is not None:
            self.local_server.leave()
        self._live = None
        self._attach(address, local_server)

    def start_server(self, system: str) -> None:
        """Serve a system on this computer with simulated devices, and connect to it."""
        self.connect_to(load_system(system).system.name, self._start_server(system))

    def _attach(self, address: str, local_server: LocalServer | None) -> None:
        self.local_server, self.failure = local_server, ""
        self.window.started_server = local_server is not None
        self.attachment = ServerAttachment(address)
        self.attachment.attached.connect(self._attached)
        self.attachment.connection_failed.connect(self._connection_failed)
        self.attachment.start()

    def _attached(self, live: LiveSource) -> None:
        if self.attachment is None or live is not self.attachment.live:
            return  # of the connection before
        old, self._live, self.failure = self._live, live, ""
        self.window.notifications.close_messages(_NO_SERVER)
        if self._recording is None or self._recording is self._left_recording:
            self._show_server()
        else:
            # What the operator looks at is not taken away.
            self._waits = True
            address = self.attachment.address
            self.window.server_banner.show_text(
                f"Connected to {address}. The recorded run stays on screen until you leave it."
            )
        if old is not None:
            self.attachment.discard(old)

    @property
    def _recording(self) -> ReplaySource | None:
        """The recorded run on screen, if any."""
        source = self.session.source
        return source if isinstance(source, ReplaySource) else None

    def _show_server(self) -> None:
        """Show the server to which the window is connected, in the place of a recorded run."""
        if self._live is None:
            return
        self._left_recording = None
        self._stop_waiting()
        self.session.set_source(self._live, self._live.connection)
        self.window.connect_dialog.accept()
        if self.local_server is not None:
            self.window.take_control()

    def _stop_waiting(self) -> None:
        self._waits = False
        self.window.server_banner.show_text("")

    def _connection_failed(self, reason: str) -> None:
        title = _NO_SERVER
        if self.local_server is not None:
            title = "The server did not start" if self._live is None else "The server ended"
            reason = self.local_server.exit_message
        # Every attempt fails with a reason; one that is known already is not repeated.
        known, self.failure = self.failure, reason
        if reason and reason != known:
            self._stop_waiting()
            self.window.connect_dialog.show_error(reason)
            self.window.notifications.show_message(Level.ERROR, title, reason)

    def close(self) -> None:
        """Disconnect, and stop the local server unless it is left running. Close the session first."""
        # Nobody was asked about a server that was never on screen.
        unseen_and_busy = self._waits and self._live is not None and is_busy(self._live.state)
        if self.local_server is not None and (self.window.leave_server or unseen_and_busy):
            self.local_server.leave()
        elif self.local_server is not None:
            self.local_server.terminate(None if self._live is None else self._live.connection)
        for attachment in (*self._stopped, self.attachment):
            if attachment is not None:
                attachment.close()


def run(system: str, address: str, screenshot: Path | None, reset_settings: bool) -> int:
    """Show the window until it is closed.

    Parameters
    ----------
    system
        System to serve with simulated devices or whose running server to attach to, or a recorded run
        (a FITS product or a run folder); empty with ``address``.
    address
        Address of a server.
    screenshot
        Save an image of the window into this file and return.
    reset_settings
        Ignore the saved settings.

    Returns
    -------
    int
        Exit code; 1 if the window was closed before its image was saved into ``screenshot``.

    Raises
    ------
    ConfigError
        There is no such system, or no display.
    ServerGone
        No server answers, so that there is nothing to save into ``screenshot``.
    StorageError
        ``screenshot`` cannot be written.
    """
    require_display()
    qt_app = qt_application()
    recording = bool(system) and is_recording(Path(system))
    address, local_server = ("", None) if recording else _find_or_start_server(system, address)
    # Niceness is that of a thread: servers are started by one that keeps the normal priority.
    starter = ThreadPoolExecutor(1, thread_name_prefix="escape-gui-starter")
    starter.submit(os.nice, 0).result()
    os.nice(_NICENESS)
    settings_path = settings_file()
    settings, warnings = (Settings(), ()) if reset_settings else load_settings(settings_path)
    session = Session()
    window = MainWindow(session, settings, None if screenshot else settings_path)
    for warning in warnings:
        log.warning("%s", warning)
        window.notifications.show_message(Level.WARNING, "Settings", warning)
    controller = WindowController(
        window, session, address, local_server, lambda name: starter.submit(LocalServer, name).result()
    )
    if recording:
        window.show_recording(read_run(Path(system)))
    window.update_timer.start()
    shot = None if screenshot is None else Screenshot(window, controller, screenshot)
    if shot is None:
        window.fit_to_screen(window.screen().availableGeometry())
    window.show()
    try:
        with _close_on_signals(window):
            code = qt_app.exec()
        if shot is not None and shot.error is not None:
            raise shot.error
        return code if shot is None or shot.saved else 1
    finally:
        session.close()
        controller.close()
        starter.shutdown()


def _find_or_start_server(system: str, address: str) -> tuple[str, LocalServer | None]:
    """The address to attach to, and the server that was started for it, if any."""
    if address:
        return address, None
    if not system:
        system = next((one.system for one in running_servers()), DEFAULT_SYSTEM)
    name = load_system(system).system.name
    listing = find_server(name)
    if listing is not None and listing.alive:
        return name, None
    return name, LocalServer(system)


@contextmanager
def _close_on_signals(window: MainWindow) -> Iterator[None]:
    """Close the window on Ctrl-C, SIGTERM and SIGHUP, because Qt swallows an exception raised in a slot.

    Nobody can be asked then: a local server with a run or a closed loop goes on.
    Python runs the handler at the next tick of the window's timer.
    """

    def close(*_: object) -> None:
        QTimer.singleShot(0, window.close_without_question)

    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    previous_handlers = {number: signal.signal(number, close) for number in numbers}
    try:
        yield
    finally:
        for number, handler in previous_handlers.items():
            signal.signal(number, handler)


class Screenshot(QObject):
    """Saves an image of a window once the engine has started or a recording is open, and closes the window.

    ``saved`` is true once the image is written; ``error`` is set if there is no server or it cannot be.
    """

    def __init__(self, window: MainWindow, controller: WindowController, path: Path) -> None:
        super().__init__(window)
        self.error: EscapeError | None = None
        self.saved = False
        self._window, self._controller, self._path = window, controller, path
        self._deadline_s = time.monotonic() + _SCREENSHOT_TIMEOUT_S
        self._poll = QTimer(self)
        self._poll.timeout.connect(self._check)
        self._poll.start(200)

    def _check(self) -> None:
        source, late = self._controller.session.source, time.monotonic() > self._deadline_s
        if isinstance(source, EmptySource):
            if late or self._controller.failure:
                reason = self._controller.failure or f"no server within {_SCREENSHOT_TIMEOUT_S:g} s"
                self.error = ServerGone(reason)
                self._end()
        elif late or (source.connected and source.state.phase is not Phase.STARTING):
            self._poll.stop()
            QTimer.singleShot(_SCREENSHOT_DELAY_MS, self._take)

    def _take(self) -> None:
        # Qt swallows an exception of a slot: the window would stay open.
        try:
            save_png(self._path, self._window)
            self.saved = True
        except EscapeError as error:
            self.error = error
        finally:
            self._end()

    def _end(self) -> None:
        self._poll.stop()
        self._window.close_without_question()
