"""``escape gui``: creates the application, connects to or starts a server, shows the main window."""

from __future__ import annotations

import ctypes.util
import logging
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pyqtgraph
from PySide6.QtCore import QObject, QTimer
from PySide6.QtWidgets import QApplication

from escape_gui.client.connection import LiveSource, LocalServer, ServerAttachment
from escape_gui.client.session import EmptySource, Session
from escape_gui.main_window import MainWindow
from escape_gui.replay.opener import REPLAY_WORKSPACE, is_recording
from escape_gui.replay.source import ReplaySource
from escape_gui.settings import Settings, load_settings, settings_file
from escape_gui.widgets.controls.status_indicator import Level
from escape_gui.window.export import save_png
from escape_hw.config.loader import load_system
from escape_hw.errors import ConfigError
from escape_hw.remote.address import find_server, running_servers
from escape_hw.remote.state import Phase


def require_display() -> None:
    """Refuse before Qt does.

    Raises
    ------
    ConfigError
        There is no display, or a library that Qt needs for it is missing; says the way out.
    """
    if os.environ.get("QT_QPA_PLATFORM") or os.environ.get("WAYLAND_DISPLAY"):
        return
    if not os.environ.get("DISPLAY"):
        raise ConfigError(
            "no display: log in with 'ssh -X', or set QT_QPA_PLATFORM=offscreen for --screenshot without one"
        )
    if ctypes.util.find_library("xcb-cursor") is None:
        raise ConfigError("Qt needs the library libxcb-cursor: install it with 'apt install libxcb-cursor0'")


log = logging.getLogger(__name__)
#: What is served when nothing is named and no server runs.
DEFAULT_SYSTEM = "razor-shwfs"
#: Milliseconds from an engine that is ready to the picture, and how long to wait for one at most.
_SCREENSHOT_DELAY_MS, _SCREENSHOT_TIMEOUT_MS = 4000, 60_000

#: A window may wait for a loop on the same machine.
_NICENESS = 10


def qt_application() -> QApplication:
    """The Qt application of this process, made once."""
    found = QApplication.instance()
    created = found if isinstance(found, QApplication) else QApplication(sys.argv[:1])
    created.setApplicationName("ESCAPE")
    # Pictures come row by row; antialiasing of curves costs five times their drawing.
    pyqtgraph.setConfigOptions(imageAxisOrder="row-major", antialias=False)
    return created


class WindowController(QObject):
    """A window, its session, the way to a server, and the server if it is the window's own.

    Parameters
    ----------
    window, session
        What is shown, and through what.
    address
        Server to attach to.
    own
        The server that was started for this window.
    """

    def __init__(
        self, window: MainWindow, session: Session, address: str, local_server: LocalServer | None
    ) -> None:
        super().__init__()
        self.window, self.session, self.local_server = window, session, local_server
        self._live: LiveSource | None = None
        self.attachment = ServerAttachment(address)
        self.attachment.attached.connect(self._attached)
        self.attachment.connection_failed.connect(self._connection_failed)
        self.attachment.start()

    def _attached(self, live: LiveSource) -> None:
        old, self._live = self._live, live
        self.session.set_source(live, live.connection)
        if old is not None:
            self.attachment.discard(old)
        if self.local_server is not None:
            self.window.take_control()

    def _connection_failed(self, reason: str) -> None:
        if self.local_server is None:
            self.window.notifications.show_message(Level.ERROR, "No server", reason)
        elif exit_message := self.local_server.exit_message:
            self.window.notifications.show_message(Level.ERROR, "The server did not start", exit_message)

    def close(self) -> None:
        """Hang up, and end the window's own server with its mirror flat; after the session was closed."""
        if self.local_server is not None:
            self.local_server.terminate(None if self._live is None else self._live.connection)
        self.attachment.close()


def run(system: str, address: str, screenshot: Path | None, reset_settings: bool) -> int:
    """Show the window until it is closed.

    Parameters
    ----------
    system
        System to serve on its twin, or whose running server is looked at; empty with ``address``. A FITS
        product or the folder of a run is shown as a recording.
    address
        Address of a server.
    screenshot
        Take a picture into this file and end.
    reset_settings
        Begin with the defaults.

    Returns
    -------
    int
        Exit code; 1 for a picture without a server.

    Raises
    ------
    ConfigError
        There is no such system, or no display.
    """
    require_display()
    qt_app = qt_application()
    recording = bool(system) and is_recording(Path(system))
    address, local_server = ("", None) if recording else _find_or_start_server(system, address)
    # Only now: a server of its own, whose engine runs a loop, stands in front.
    os.nice(_NICENESS)
    settings_path = settings_file()
    settings, warnings = (Settings(), ()) if reset_settings else load_settings(settings_path)
    session = Session()
    window = MainWindow(session, settings, None if screenshot else settings_path)
    for warning in warnings:
        log.warning("%s", warning)
        window.notifications.show_message(Level.WARNING, "Settings", warning)
    if screenshot is not None:
        _take_screenshot(window, session, screenshot)
    desk = None
    if recording:
        session.set_source(ReplaySource(system), None)
        window.show_workspace(REPLAY_WORKSPACE)
    else:
        desk = WindowController(window, session, address, local_server)
    window.update_timer.start()
    window.show()
    try:
        with _close_on_signals(qt_app):
            code = qt_app.exec()
        # A picture of a window that never found its server is no picture of what was asked for.
        return code if screenshot is None or not isinstance(session.source, EmptySource) else 1
    finally:
        session.close()
        if desk is not None:
            desk.close()


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
def _close_on_signals(qt_app: QApplication) -> Iterator[None]:
    """Ctrl-C and SIGTERM close the window in order; an exception out of a slot would be swallowed by Qt.

    Python hears of them with the next tick.
    """

    def close(*_: object) -> None:
        QTimer.singleShot(0, qt_app.closeAllWindows)

    previous_handlers = {number: signal.signal(number, close) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in previous_handlers.items():
            signal.signal(number, handler)


def _take_screenshot(window: MainWindow, session: Session, path: Path) -> None:
    """Take the picture when something is to be seen, and close the window."""
    waiting = QTimer(window)

    def take() -> None:
        save_png(path, window)
        window.close()

    def look() -> None:
        source = session.source
        if source.connected and source.state.phase is not Phase.STARTING:
            waiting.stop()
            QTimer.singleShot(_SCREENSHOT_DELAY_MS, take)

    waiting.timeout.connect(look)
    waiting.start(200)
    QTimer.singleShot(_SCREENSHOT_TIMEOUT_MS, take)
