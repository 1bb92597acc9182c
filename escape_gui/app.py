"""``escape gui``: makes the application, finds or starts a server, shows the window."""

from __future__ import annotations

import logging
import sys
from pathlib import Path

import pyqtgraph
from PySide6.QtCore import QTimer
from PySide6.QtWidgets import QApplication

from escape_gui.exports import save_png
from escape_gui.main_window import MainWindow
from escape_gui.replay.desk import WORKSPACE, is_recording
from escape_gui.replay.source import ReplaySource
from escape_gui.session import Session
from escape_gui.settings import Settings, load_settings, settings_file

log = logging.getLogger(__name__)
#: Milliseconds until a picture is taken: some frames have come by then.
SCREENSHOT_AFTER_MS = 4000


def application() -> QApplication:
    """The Qt application of this process, made once."""
    found = QApplication.instance()
    made = found if isinstance(found, QApplication) else QApplication(sys.argv[:1])
    made.setApplicationName("ESCAPE")
    # Pictures come row by row; antialiasing of curves costs five times their drawing.
    pyqtgraph.setConfigOptions(imageAxisOrder="row-major", antialias=False)
    return made


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
        Exit code.
    """
    qt = application()
    store = settings_file()
    settings, warnings = (Settings(), ()) if reset_settings else load_settings(store)
    session = Session()
    window = MainWindow(session, settings, None if screenshot else store)
    for warning in warnings:
        log.warning("%s", warning)
    if system and is_recording(Path(system)):
        session.use(ReplaySource(system), None)
        window.show_workspace(WORKSPACE)
    window.ticker.start()
    window.show()
    if screenshot is not None:
        path = screenshot

        def take() -> None:
            save_png(path, window)
            window.close()

        QTimer.singleShot(SCREENSHOT_AFTER_MS, take)
    try:
        return qt.exec()
    finally:
        session.close()
