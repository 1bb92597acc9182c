"""Windows for tests: created, refreshed, closed and deleted."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from PySide6.QtCore import QCoreApplication, QEvent, QPoint, Qt
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QApplication, QCheckBox, QComboBox, QLineEdit

from escape_gui.client.session import Session
from escape_gui.main_window import MainWindow
from escape_gui.panels import PANELS
from escape_gui.panels.base import Panel
from escape_gui.settings import Settings
from escape_gui.widgets.argument_form import ArgumentForm
from escape_gui.widgets.images import ImageViewer


def settle() -> None:
    """Process deferred deletions of Qt, and collect garbage."""
    QCoreApplication.sendPostedEvents(None, QEvent.Type.DeferredDelete.value)
    QCoreApplication.processEvents()
    gc.collect()
    QCoreApplication.sendPostedEvents(None, QEvent.Type.DeferredDelete.value)


def show_window(
    session: Session,
    settings_path: Path,
    panels: Sequence[type[Panel]] = PANELS,
    settings: Settings | None = None,
) -> MainWindow:
    """A window that was refreshed once."""
    window = MainWindow(session, settings or Settings(), settings_path, panels)
    window.show()
    QCoreApplication.processEvents()
    window.update_timer.tick(force=True)
    QCoreApplication.processEvents()
    return window


def wait_for(done: Callable[[], object]) -> None:
    """Process events until a condition is true."""
    for _ in range(12_000):
        if done():
            return
        QTest.qWait(10)
    raise AssertionError("never happened")


def refresh(window: MainWindow) -> None:
    """Process events, and refresh all panels, none of which may fail."""
    QApplication.processEvents()
    window.update_timer.tick(force=True)
    QApplication.processEvents()
    assert window.update_timer.failed_panels == {}


def until(what: Callable[[], bool], window: MainWindow) -> None:
    """Refresh a window until a condition is true."""
    deadline = time.monotonic() + 30
    while not what():
        assert time.monotonic() < deadline
        refresh(window)
        time.sleep(0.005)


def dispose(window: MainWindow) -> None:
    """Close and delete a window."""
    window.close_without_question()
    window.deleteLater()


def enter_argument(form: ArgumentForm, name: str, text: str) -> None:
    """Enter a value into a field of a form."""
    field = form.fields[name]
    if isinstance(field, QLineEdit):
        field.setText(text)
        field.textEdited.emit(text)
    elif isinstance(field, QComboBox):
        field.setCurrentText(text)
    elif isinstance(field, QCheckBox):
        field.setChecked(text == "True")


def click_pixel(view: ImageViewer, x: int, y: int, *, twice: bool = False) -> None:
    """Click the middle of a pixel."""
    place = view.view.mapFromScene(view.image.mapToScene(x + 0.5, y + 0.5))
    press = QTest.mouseDClick if twice else QTest.mouseClick
    press(view.view.viewport(), Qt.MouseButton.LeftButton, pos=QPoint(place.x(), place.y()))
    QApplication.processEvents()
