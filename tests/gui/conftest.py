"""Fixtures: a window on a scripted source; every test is checked for leaks."""

from __future__ import annotations

import gc
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest

os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")

import shiboken6
from command_line import escape  # noqa: F401 (a fixture)
from gui_windows import dispose, settle, show_window
from PySide6.QtCore import Qt, QTimer
from PySide6.QtWidgets import QApplication
from scripted import ScriptedControl, ScriptedSource

from escape_gui.app import qt_application
from escape_gui.client.session import Session
from escape_gui.main_window import MainWindow
from escape_gui.panels import PANELS
from escape_gui.panels.base import Panel
from escape_gui.panels.camera import CameraPanel
from escape_gui.panels.devices import DevicesPanel
from escape_gui.panels.log import LogPanel
from escape_gui.settings import Settings
from escape_gui.widgets import controls


@pytest.fixture(scope="session")
def qapp() -> QApplication:
    """The application, configured as by the command."""
    application = qt_application()
    # Every test collects garbage and looks through all objects: those that are there for good are left out.
    gc.collect()
    gc.freeze()
    return application


def segments() -> set[str]:
    """Shared-memory segments of this process."""
    folder = Path("/dev/shm")
    return {path.name for path in folder.glob(f"escape-*-{os.getpid()}-*")} if folder.is_dir() else set()


def timers() -> set[int]:
    """Running timers."""
    found = (one for one in gc.get_objects() if isinstance(one, QTimer))
    return {id(one) for one in found if shiboken6.isValid(one) and one.isActive()}


def widgets() -> dict[int, str]:
    """All widgets but Qt's own of the desktop, by the address of their C++ object, which identifies them."""
    found = (one for one in QApplication.allWidgets() if one.windowType() != Qt.WindowType.Desktop)
    return {shiboken6.getCppPointer(one)[0]: repr(one) for one in found}


@pytest.fixture(autouse=True)
def no_leaks(qapp: QApplication) -> Iterator[None]:
    """Fail a test that leaves a widget, a running timer, a thread or shared memory behind."""
    settle()
    before = widgets().keys()
    threads, shared, running = set(threading.enumerate()), segments(), timers()
    yield
    for _ in range(4):
        # Some reference cycles are collected only after the deletion of their widgets.
        settle()
        left = [name for place, name in widgets().items() if place not in before]
        if not left:
            break
    assert not left, f"widgets left behind: {left}"
    assert timers() <= running, "a timer still runs"
    assert set(threading.enumerate()) <= threads, "a thread still runs"
    assert segments() <= shared, "shared memory is left"


@pytest.fixture
def source() -> ScriptedSource:
    """A closed loop, with an entry in every stream."""
    source = ScriptedSource()
    source.push_all()
    return source


@pytest.fixture
def control() -> ScriptedControl:
    """A server that records the requests."""
    return ScriptedControl()


@pytest.fixture
def session(source: ScriptedSource, control: ScriptedControl) -> Iterator[Session]:
    """A session with both."""
    session = Session()
    session.set_source(source, control)
    yield session
    session.close()
    session.deleteLater()


@pytest.fixture
def make_window(session: Session, tmp_path: Path) -> Iterator[Callable[..., MainWindow]]:
    """Creates windows with some panels, and closes them."""
    made: list[MainWindow] = []

    def make(panels: Sequence[type[Panel]] = PANELS, settings: Settings | None = None) -> MainWindow:
        made.append(show_window(session, tmp_path / "gui.json", panels, settings))
        for dock in made[-1].docks.values() if len(panels) == 1 else ():
            dock.show()
        made[-1].update_timer.tick(force=True)
        return made[-1]

    yield make
    for window in made:
        if shiboken6.isValid(window):
            dispose(window)


@pytest.fixture
def short_hold(monkeypatch: pytest.MonkeyPatch) -> None:
    """Buttons that are held for a quarter of their time."""
    monkeypatch.setattr(controls, "HOLD_MS", controls.HOLD_MS // 4)


@pytest.fixture
def window(session: Session, tmp_path: Path) -> Iterator[MainWindow]:
    """The whole window."""
    window = show_window(session, tmp_path / "gui.json")
    yield window
    dispose(window)


@pytest.fixture
def small_window(session: Session, tmp_path: Path) -> Iterator[MainWindow]:
    """A window with three panels, for tests that do not depend on the others."""
    window = show_window(session, tmp_path / "gui.json", (DevicesPanel, CameraPanel, LogPanel))
    yield window
    dispose(window)
