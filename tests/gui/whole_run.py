"""A window on a real server, and an operator who calibrates with it."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import serving
from gui_windows import dispose, enter_argument
from PySide6.QtCore import Qt
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QApplication, QPushButton

from escape_gui.app import WindowController
from escape_gui.client.session import Session
from escape_gui.main_window import MainWindow
from escape_gui.panels.procedure import ProcedurePanel
from escape_gui.settings import Settings
from escape_hw.remote.state import FinishedRun, Phase

#: Longest wait for a step; a calibration takes minutes on a busy machine.
PATIENCE_S = 900.0


class Operator:
    """Operates the window and waits for results.

    Parameters
    ----------
    window
        Connected to a server.
    """

    def __init__(self, window: MainWindow) -> None:
        self.window = window
        panel = window.panels["procedure"]
        assert isinstance(panel, ProcedurePanel)
        self.procedure = panel
        #: Observations during procedures, by kind.
        self.seen: dict[str, list[float]] = {"live_modes": [], "iterations": [], "gains": [], "abort": []}

    def until(self, what: Callable[[], bool], why: str) -> None:
        """Process events until a condition is true."""
        deadline = time.monotonic() + PATIENCE_S
        while not what():
            assert time.monotonic() < deadline, f"never happened: {why}"
            QApplication.processEvents()
            assert self.window.update_timer.failed_panels == {}
            time.sleep(0.01)

    def press(self, button: QPushButton) -> None:
        """Click an enabled button."""
        assert button.isEnabled(), button.toolTip()
        QTest.mouseClick(button, Qt.MouseButton.LeftButton)

    def take_control(self) -> None:
        """Wait until the bench is ready, and take control."""
        session = self.window.context.session
        self.until(lambda: session.source.state.phase is Phase.IDLE, "the engine is idle")
        self.until(lambda: self.procedure._state.phase is Phase.IDLE, "the panel knows")
        self.window.actions_by_name["take_control"].trigger()
        self.until(lambda: session.may_write, "we have control")

    def choose(self, name: str, **arguments: str) -> None:
        """Fill in a procedure's form, and wait for its plan."""
        form = self.procedure
        self.until(lambda: form.choice.findData(name) >= 0, "procedures are offered")
        form.choice.setCurrentIndex(form.choice.findData(name))
        for key, text in arguments.items():
            enter_argument(form.form, key, text)
        self.until(form.start.isEnabled, f"{name} is planned: {form.plan.text()}")

    def run(self, name: str, **arguments: str) -> FinishedRun:
        """Start a procedure with its button, and wait for its end."""
        self.choose(name, **arguments)
        source = self.window.context.session.source
        before = source.state.last_run.id if source.state.last_run is not None else 0
        self.press(self.procedure.start)
        self.until(lambda: source.state.active_run is not None, "it runs")
        self.until(lambda: self._watch() and self.ended(before), "it ends")
        last = source.state.last_run
        assert last is not None
        self.until(lambda: self.procedure._ended is not None and self.procedure._ended.id == last.id, "told")
        return last

    def ended(self, before: int) -> bool:
        """Whether a procedure has ended since the one with that number."""
        state = self.window.context.session.source.state
        return state.active_run is None and state.last_run is not None and state.last_run.id != before

    def settle(self, seconds: float) -> None:
        """Process events for some time."""
        until = time.monotonic() + seconds
        self.until(lambda: time.monotonic() > until, "time goes by")

    def _watch(self) -> bool:
        panels, seen = self.window.panels, self.seen
        if panels["modes"].matrix_selector.currentData() == "live":
            seen["live_modes"].append(panels["modes"].mosaic.n_modes)
        if (course := panels["sprint"]._history) is not None:
            seen["iterations"].append(len(course.values))
        seen["gains"].append(len(panels["gains"]._curves))
        seen["abort"].append(self.procedure.abort.isEnabled())
        return True


@contextmanager
def operator_window(system: str, **settings: str) -> Iterator[Operator]:
    """A window as created by the command, connected to the server of a system on this computer."""
    session = Session()
    window = MainWindow(session, Settings(**{"workspace": "calibrate", **settings}), None)
    controller = WindowController(window, session, system, None)
    window.resize(1280, 800)
    window.update_timer.start()
    window.show()
    try:
        yield Operator(window)
    finally:
        dispose(window)
        session.close()
        session.deleteLater()
        controller.close()
        controller.deleteLater()


@contextmanager
def operating(system: str | Path, folder: Path, **settings: str) -> Iterator[Operator]:
    """A server of a system, and a window on it."""
    # Long time limits: on a busy computer frames are late, and a window is silent while its image is saved.
    limits = {"engine_silence_s": 120, "no_frames_s": 60, "lease_s": 60}
    patient = [word for name, value in limits.items() for word in ("--set", f"server.{name}={value}")]
    with serving.serving(system, "--quiet", *patient, folder=folder) as served:
        os.environ["XDG_RUNTIME_DIR"] = served.environment["XDG_RUNTIME_DIR"]
        with operator_window(serving.SYSTEM, **settings) as operator:
            yield operator
