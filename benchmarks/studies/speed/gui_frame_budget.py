"""Processor time of the window per refresh, in every workspace and two sizes, against its period of 33 ms.

New entries arrive in every stream before each refresh, faster than from a server; the panels take them at
their own rates. Prints the median and the 99th percentile of the time of a refresh alone, and with the
drawing that follows it, in software and without a display.
``python benchmarks/studies/speed/gui_frame_budget.py [TICKS]``.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from pathlib import Path
from typing import cast

os.environ["QT_QPA_PLATFORM"] = "offscreen"
sys.path.insert(0, str(Path(__file__).resolve().parents[3] / "tests"))
sys.path.insert(0, str(Path(__file__).resolve().parents[3] / "tests" / "gui"))

import numpy as np
from gui_windows import dispose, settle, show_window
from PySide6.QtWidgets import QApplication
from scripted import ScriptedControl, ScriptedSource

from escape_gui.app import qt_application
from escape_gui.client.session import Session
from escape_gui.main_window import MainWindow
from escape_gui.window.docks import WORKSPACES
from escape_gui.window.update_timer import TICK_MS
from escape_hw.remote.client import Connection

SIZES = ((1280, 800), (2560, 1440))
TICKS = 150
#: Refreshes that are not counted: the first drawing of everything.
_FIRST = 10


def measure(window: MainWindow, source: ScriptedSource, ticks: int) -> np.ndarray:
    """Milliseconds of refreshes alone, and with drawing ``(ticks, 2)``."""
    times = np.empty((ticks + _FIRST, 2))
    for k in range(len(times)):
        source.push_all(k)
        source.change()
        began, began_s = time.process_time(), time.monotonic()
        window.update_timer.tick()
        refreshed = time.process_time()
        QApplication.processEvents()
        times[k] = 1000 * (refreshed - began), 1000 * (time.process_time() - began)
        time.sleep(max(0.0, TICK_MS / 1000 - (time.monotonic() - began_s)))
    return times[_FIRST:]


def main() -> None:
    """Measure and print."""
    ticks = int(sys.argv[1]) if sys.argv[1:] else TICKS
    application = qt_application()
    source, session = ScriptedSource(), Session()
    source.push_all()
    session.set_source(source, cast(Connection, ScriptedControl()))
    with tempfile.TemporaryDirectory() as folder:
        window = show_window(session, Path(folder) / "gui.json")
        # Only this script refreshes it.
        window.update_timer.stop()
        for width, height in SIZES:
            window.resize(width, height)
            settle()
            for one in WORKSPACES:
                window.show_workspace(one.name)
                application.processEvents()
                times = measure(window, source, ticks)
                typical, late = np.median(times, axis=0), np.percentile(times, 99, axis=0)
                print(
                    f"{width} x {height} {one.name:<9} refresh {typical[0]:5.2f} ms, p99 {late[0]:5.2f} ms; "
                    f"with drawing {typical[1]:5.2f} ms, p99 {late[1]:5.2f} ms of {TICK_MS} ms",
                    flush=True,
                )
        dispose(window)
        session.close()


if __name__ == "__main__":
    main()
