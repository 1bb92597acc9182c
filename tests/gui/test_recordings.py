"""Recorded runs and products in the window: opening, drag and drop, playback."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import recorded_run
import shiboken6
from gui_windows import dispose, until
from PySide6.QtCore import QEvent, QMimeData, QPoint, QPointF, Qt, QUrl
from PySide6.QtGui import QDragEnterEvent, QDropEvent
from PySide6.QtWidgets import QApplication, QFileDialog

from escape_gui.client.session import Session
from escape_gui.main_window import MainWindow
from escape_gui.panels import PANELS
from escape_gui.panels.base import Panel
from escape_gui.panels.camera import CameraPanel
from escape_gui.panels.mirror import MirrorPanel
from escape_gui.panels.procedure import ProcedurePanel
from escape_gui.panels.sprint import SprintPanel
from escape_gui.replay.source import ReplaySource
from escape_gui.settings import Settings
from escape_gui.widgets.controls import Level


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recorded_run.make_run(tmp_path_factory.mktemp("recorded") / "run")


@pytest.fixture
def panels() -> tuple[type[Panel], ...]:
    """The panels of the window: those that most tests look at."""
    return (ProcedurePanel, SprintPanel, CameraPanel, MirrorPanel)


@pytest.fixture
def empty(panels: tuple[type[Panel], ...]) -> Iterator[MainWindow]:
    """A window without a source."""
    session = Session()
    window = MainWindow(session, Settings(workspace="operate"), None, panels)
    window.resize(1600, 1000)
    window.show()
    yield window
    dispose(window)
    session.close()
    session.deleteLater()


def is_open(window: MainWindow) -> bool:
    return isinstance(window.context.session.source, ReplaySource)


@pytest.mark.parametrize("panels", [PANELS], ids=["all panels"])
def test_a_run_is_shown_by_every_panel(empty, folder):
    empty.replay.open(folder)
    until(lambda: is_open(empty), empty)
    assert empty.workspace.name == "calibrate"
    modes = empty.panels["modes"]
    until(lambda: list(modes.matrices) == ["push-pull", "DO-CRIME", "ESCAPE"], empty)
    for name in ("calibrate", "operate", "align"):
        empty.show_workspace(name)
        for _ in range(3):
            until(lambda: True, empty)
            QApplication.processEvents()
    for panel in PANELS:
        empty.docks[panel.name].show()
    empty.update_timer.tick(force=True)
    sprint, gains = empty.panels["sprint"], empty.panels["gains"]
    assert sprint._indicator.text == "converged, 18 iterations"
    assert list(gains._curves) == ["ESCAPE", "DO-CRIME"]
    assert not empty.panels["psf"].shows_placeholder


def test_unknown_values_of_a_recorded_run_are_not_zero(empty, folder):
    empty.replay.open(folder)
    until(lambda: is_open(empty), empty)
    for name in ("camera", "mirror"):
        empty.docks[name].show()
        empty.docks[name].raise_()
        QApplication.processEvents()
        until(lambda: True, empty)
    header, panels = empty.header, empty.panels
    assert {one.text for one in header.readouts.values()} == {"–"}
    assert (header.saturation.level, header.saturation.text) == (Level.NEUTRAL, "saturated –")
    assert panels["camera"].saturation.text() == "peak –   saturated –"
    assert {one.text for one in panels["mirror"].readouts.values()} == {"–"}


def test_no_procedure_can_be_started_and_the_reason_is_shown(empty, folder):
    empty.replay.open(folder)
    until(lambda: is_open(empty), empty)
    until(lambda: bool(empty.panels["procedure"].start.toolTip()), empty)
    procedure = empty.panels["procedure"]
    for button in (procedure.check, procedure.start, procedure.pause, procedure.abort):
        assert not button.isEnabled()
        assert "replay of a recorded run" in button.toolTip()
    assert "recorded run" in procedure._description.text()
    # The state of the run may come with a later refresh than its source.
    until(lambda: procedure.outcome.text() == "Done: A run", empty)


def test_the_slider_moves_through_the_run(empty, folder):
    empty.replay.open(folder)
    until(lambda: is_open(empty), empty)
    sprint, playback_bar = empty.panels["sprint"], empty.playback_bar
    until(lambda: sprint._history is not None and len(sprint._history.values) == 18, empty)
    assert playback_bar.isVisible()
    playback_bar.slider.setValue(playback_bar.slider.maximum() // 2)
    until(lambda: len(sprint._history.values) == 9, empty)
    assert sprint._indicator.text == "running, 9 iterations"
    assert playback_bar.position_label.text().strip() == "step 250 of 500"
    playback_bar.slider.setValue(playback_bar.slider.maximum() - 2)
    playback_bar.play.click()
    until(lambda: not playback_bar.play.isChecked(), empty)
    until(lambda: len(sprint._history.values) == 18, empty)
    until(lambda: sprint._indicator.text == "converged, 18 iterations", empty)


def test_a_recorded_run_is_not_taken_for_the_bench(small_window, folder):
    small_window.show_recording(ReplaySource(folder))
    (other,) = small_window.replay_windows
    other.update_timer.tick(force=True)
    assert other.windowTitle() == f"REPLAY · {folder.name} · ESCAPE"
    assert "REPLAY OF A RECORDED RUN" in other.header.connection_banner.text()
    colour = other.context.theme.colours.replay
    assert colour in other.header.connection_banner.styleSheet()
    assert colour in other.styleSheet()
    assert not other.header.flatten_button.isVisible()
    assert other.pos() != small_window.pos()
    assert small_window.header.flatten_button.isVisible()
    small_window.refresh()
    assert "REPLAY" not in small_window.windowTitle()


@pytest.mark.parametrize("name", ["", "escape.fits"])
def test_dropped_files_are_opened(empty, folder, name):
    data = QMimeData()
    data.setUrls([QUrl.fromLocalFile(str(folder / name))])
    arguments = (Qt.DropAction.CopyAction, data, Qt.MouseButton.LeftButton, Qt.KeyboardModifier.NoModifier)
    for kind, place in ((QDragEnterEvent, QPoint(50, 50)), (QDropEvent, QPointF(50, 50))):
        event = kind(place, *arguments)
        QApplication.sendEvent(empty, event)
        assert event.isAccepted()
    until(lambda: is_open(empty), empty)


def test_an_unreadable_file_is_notified(empty, tmp_path, monkeypatch):
    path = tmp_path / "im.fits"
    path.write_bytes(b"no FITS")
    monkeypatch.setattr(QFileDialog, "getOpenFileName", lambda *_: (str(path), ""))
    told: list[str] = []
    monkeypatch.setattr(empty.notifications, "show_message", lambda _level, _title, text: told.append(text))
    empty.actions_by_name["open_product"].trigger()
    until(lambda: bool(told), empty)
    assert "im.fits: not a FITS file" in told[0]
    assert not is_open(empty)


@pytest.mark.parametrize("damage", [{"track": {"seconds": [1, 2]}}, {"bench": {"layout": ["1", "11"]}}])
def test_a_run_with_a_damaged_document_is_notified(empty, folder, tmp_path, damage):
    damaged = shutil.copytree(folder, tmp_path / "damaged")
    document = json.loads((damaged / "result.json").read_text())
    (damaged / "result.json").write_text(json.dumps(document | damage))
    empty.replay.open(damaged)
    until(lambda: bool(empty.notifications.notifications), empty)
    (told,) = empty.notifications.notifications
    assert "its document is damaged" in told.text
    assert "open its products one by one" in told.text
    assert not is_open(empty)


def test_a_window_on_a_bench_opens_recorded_runs_in_another_window(small_window, folder, monkeypatch):
    """The safety buttons of a window on a bench must remain those of the bench."""
    monkeypatch.setattr(QFileDialog, "getExistingDirectory", lambda *_: str(folder))
    small_window.actions_by_name["open_run"].trigger()
    until(lambda: bool(small_window.replay_windows), small_window)
    assert not is_open(small_window)
    (other,) = small_window.replay_windows
    assert is_open(other)
    assert other.isVisible()
    assert np.array_equal(
        other.context.session.source.latest("valid").data > 0, recorded_run.calibration("escape").grid.valid
    )


def test_a_closed_replay_is_released(small_window, folder):
    small_window.show_recording(ReplaySource(folder))
    (other,) = small_window.replay_windows
    other.close()
    assert not small_window.replay_windows
    QApplication.sendPostedEvents(other, QEvent.Type.DeferredDelete)
    assert not shiboken6.isValid(other)
    small_window.refresh()
