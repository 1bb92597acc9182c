"""``escape gui``: makes the application, finds or starts a server, shows the window."""

from __future__ import annotations

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

from escape_gui.display import check_display
from escape_gui.exports import save_png
from escape_gui.live import Attachment, LiveSource
from escape_gui.main_window import MainWindow
from escape_gui.own_server import OwnServer
from escape_gui.replay.desk import WORKSPACE, is_recording
from escape_gui.replay.source import ReplaySource
from escape_gui.session import NoSource, Session
from escape_gui.settings import Settings, load_settings, settings_file
from escape_gui.widgets.status_pill import Level
from escape_hw.config.load import load_system
from escape_hw.remote.address import find_listing, servers
from escape_hw.remote.state import Phase

log = logging.getLogger(__name__)
#: What is served when nothing is named and no server runs.
DEFAULT_SYSTEM = "razor-shwfs"
#: Milliseconds from an engine that is ready to the picture, and how long to wait for one at most.
_PICTURE_AFTER_MS, _PICTURE_AT_LAST_MS = 4000, 60_000

#: A window may wait for a loop on the same machine.
_NICENESS = 10


def application() -> QApplication:
    """The Qt application of this process, made once."""
    found = QApplication.instance()
    made = found if isinstance(found, QApplication) else QApplication(sys.argv[:1])
    made.setApplicationName("ESCAPE")
    # Pictures come row by row; antialiasing of curves costs five times their drawing.
    pyqtgraph.setConfigOptions(imageAxisOrder="row-major", antialias=False)
    return made


class Desk(QObject):
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

    def __init__(self, window: MainWindow, session: Session, address: str, own: OwnServer | None) -> None:
        super().__init__()
        self.window, self.session, self.own = window, session, own
        self._live: LiveSource | None = None
        self.attachment = Attachment(address)
        self.attachment.attached.connect(self._attached)
        self.attachment.failing.connect(self._failing)
        self.attachment.start()

    def _attached(self, live: LiveSource) -> None:
        old, self._live = self._live, live
        self.session.use(live, live.connection)
        if old is not None:
            self.attachment.drop(old)
        if self.own is not None:
            self.window.take_control()

    def _failing(self, reason: str) -> None:
        if self.own is None:
            self.window.toasts.tell(Level.BAD, "No server", reason)
        elif failure := self.own.failure:
            self.window.toasts.tell(Level.BAD, "The server did not start", failure)

    def close(self) -> None:
        """Hang up, and end the window's own server with its mirror flat; after the session was closed."""
        if self.own is not None:
            self.own.end(None if self._live is None else self._live.connection)
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
    check_display()
    qt = application()
    recording = bool(system) and is_recording(Path(system))
    address, own = ("", None) if recording else _server(system, address)
    # Only now: a server of its own, whose engine runs a loop, stands in front.
    os.nice(_NICENESS)
    store = settings_file()
    settings, warnings = (Settings(), ()) if reset_settings else load_settings(store)
    session = Session()
    window = MainWindow(session, settings, None if screenshot else store)
    for warning in warnings:
        log.warning("%s", warning)
        window.toasts.tell(Level.WARN, "Settings", warning)
    if screenshot is not None:
        _picture(window, session, screenshot)
    desk = None
    if recording:
        session.use(ReplaySource(system), None)
        window.show_workspace(WORKSPACE)
    else:
        desk = Desk(window, session, address, own)
    window.ticker.start()
    window.show()
    try:
        with _closed_by_signals(qt):
            code = qt.exec()
        # A picture of a window that never found its server is no picture of what was asked for.
        return code if screenshot is None or not isinstance(session.source, NoSource) else 1
    finally:
        session.close()
        if desk is not None:
            desk.close()


def _server(system: str, address: str) -> tuple[str, OwnServer | None]:
    """The address to attach to, and the server that was started for it, if any."""
    if address:
        return address, None
    if not system:
        system = next((one.system for one in servers()), DEFAULT_SYSTEM)
    name = load_system(system).system.name
    listing = find_listing(name)
    if listing is not None and listing.alive:
        return name, None
    return name, OwnServer(system)


@contextmanager
def _closed_by_signals(qt: QApplication) -> Iterator[None]:
    """Ctrl-C and SIGTERM close the window in order; an exception out of a slot would be swallowed by Qt.

    Python hears of them with the next tick.
    """

    def close(*_: object) -> None:
        QTimer.singleShot(0, qt.closeAllWindows)

    before = {number: signal.signal(number, close) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _picture(window: MainWindow, session: Session, path: Path) -> None:
    """Take the picture when something is to be seen, and close the window."""
    waiting = QTimer(window)

    def take() -> None:
        save_png(path, window)
        window.close()

    def look() -> None:
        source = session.source
        if source.connected and source.state.phase is not Phase.STARTING:
            waiting.stop()
            QTimer.singleShot(_PICTURE_AFTER_MS, take)

    waiting.timeout.connect(look)
    waiting.start(200)
    QTimer.singleShot(_PICTURE_AT_LAST_MS, take)
