"""Recording and analysis of telemetry in the window, and the browser of recordings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from gui_windows import wait_for
from PySide6.QtCore import QPoint, QPointF, Qt
from PySide6.QtGui import QWheelEvent
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QApplication
from scripted import ScriptedControl, ScriptedSource

from escape_gui.main_window import MainWindow
from escape_gui.panels.telemetry import ONE_MODE, SLOPES, TelemetryPanel
from escape_gui.views.telemetry import describe_growth
from escape_hw.io.provenance import format_utc
from escape_hw.remote.state import RecordingState
from escape_hw.runtime.session.recordings import RecordingDescription, find_recordings, write_description
from escape_hw.streams.recording.block_file import HEADER, write_block


def record(folder: Path, n: int = 1024, n_modes: int = 20) -> Path:
    """A recording of white residuals and of one actuator that does not move."""
    rng = np.random.default_rng(1)
    folder.mkdir(parents=True)
    write_description(
        folder, RecordingDescription("bench", True, format_utc(), 500.0, 0.4, 0.01, loop_closed=True)
    )
    streams = {"slopes": (200, 0.3), "residual_modes": (n_modes, 20.0), "commands": (97, 0.1)}
    for name, (width, rms) in streams.items():
        head = np.zeros(n, HEADER)
        head["index"], head["arrived_ns"] = np.arange(n), np.arange(n) * 2_000_000 + len(name)
        data = (rms * rng.standard_normal((n, width))).astype(np.float32)
        if name == "commands":
            data[:, 5] = 0.0
        with open(folder / f"{name}.blocks", "wb", buffering=0) as file:
            write_block(file, head, data)
    return folder


@pytest.fixture
def runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr("escape_gui.window.browser.runs_folder", lambda session: tmp_path)
    return tmp_path


@pytest.fixture
def window(make_window) -> MainWindow:
    made: MainWindow = make_window((TelemetryPanel,))
    return made


@pytest.fixture
def panel(window: MainWindow) -> TelemetryPanel:
    found = window.panels["telemetry"]
    assert isinstance(found, TelemetryPanel)
    return found


def test_a_recording_of_some_seconds_is_requested_grows_and_is_analysed(
    window: MainWindow, panel: TelemetryPanel, source: ScriptedSource, control: ScriptedControl, runs: Path
):
    assert panel.growth.text() == "no recording yet"
    panel.seconds.setValue(5)
    QTest.mouseClick(panel.record_button, Qt.MouseButton.LeftButton)
    wait_for(lambda: "record" in control.verbs)
    assert control.asked[-1] == ("record", {"args": (True,), "images": False, "seconds": 5.0})
    folder = runs / "2026-11-22" / "213000_telemetry"
    going = RecordingState(
        recording=True, path=str(folder), written=1200, size=2_500_000, started_utc=format_utc()
    )
    source.change(recording=going)
    window.update_timer.tick(force=True)
    assert panel.record_button.text() == "Stop"
    assert "1,200 entries · 2.5 MB" in panel.growth.text()
    record(folder)
    source.change(recording=going.model_copy(update={"recording": False, "written": 3072}))
    window.update_timer.tick(force=True)
    assert panel.record_button.text() == "Record"
    # Files that were still being written when the recording ended are analysed again.
    wait_for(lambda: "no modes without correction" in panel.source_label.text())
    assert "1,024 frames, 2.0 s" in panel.source_label.text()


def test_a_recording_of_a_hidden_panel_is_analysed_when_it_is_shown(
    window: MainWindow, panel: TelemetryPanel, source: ScriptedSource, runs: Path
):
    folder = record(runs / "2026-11-22" / "213000_telemetry")
    ended = RecordingState(recording=False, path=str(folder), written=3072, started_utc=format_utc())
    source.change(recording=ended)
    window.update_timer.tick(force=True)
    wait_for(lambda: "1,024 frames, 2.0 s" in panel.source_label.text())
    # Another one that the operator opens stays.
    other = record(runs / "2026-11-22" / "214000_telemetry")
    panel.open_recording(other)
    wait_for(lambda: panel._folder == other)
    source.change(recording=ended)
    window.update_timer.tick(force=True)
    assert not panel._busy


def test_all_views_show_the_analysis_in_both_themes(
    window: MainWindow, panel: TelemetryPanel, source: ScriptedSource, runs: Path
):
    panel.open_recording(record(runs / "2026-11-22" / "213000_telemetry"))
    wait_for(lambda: panel.analysis is not None)
    drawn = panel.residual.curves["residual"].getOriginalDataset()[1]
    assert np.mean(drawn) == pytest.approx(20.0, rel=0.1)
    panel.view.choose("Spectra")
    for kind in (ONE_MODE, SLOPES, "all modes"):
        panel.kind.setCurrentText(kind)
        assert panel.mode.isVisibleTo(panel) == (kind == ONE_MODE)
    panel.view.choose("Gains")
    window.context.theme.set_palette("light")
    panel.view.choose("Elements")
    item = panel.table.item(0, 0)
    assert item is not None
    assert item.text() == "actuator 5"
    names = [one.name for one in panel.export_arrays()]
    assert names == ["spectra", "modes"]


def test_axes_without_data_have_no_numbers(window: MainWindow, panel: TelemetryPanel):
    plot = panel.residual
    assert not any(axis.style["showValues"] for axis in plot._axes)
    plot.show_modes(np.ones(5), np.ones(5))
    assert all(axis.style["showValues"] for axis in plot._axes)
    window.context.theme.set_palette("light")
    assert all(axis.style["showValues"] for axis in plot._axes)


def test_a_damaged_recording_says_so(panel: TelemetryPanel, tmp_path: Path):
    panel.open_recording(tmp_path)
    wait_for(lambda: panel.message.isVisibleTo(panel))
    assert "no slopes are recorded" in panel.message.text()


def test_recordings_are_filtered_opened_and_deleted_after_a_question(
    window: MainWindow, panel: TelemetryPanel, runs: Path
):
    for name in ("213000_telemetry", "220000_telemetry"):
        record(runs / "2026-11-22" / name)
    browser = window.recording_browser
    QTest.mouseClick(panel.browse_button, Qt.MouseButton.LeftButton)
    wait_for(lambda: browser.table.rowCount() == 2)
    assert "2 recordings" in browser.message.text()
    assert not browser.delete_button.isEnabled()
    QTest.keyClicks(browser.filter, "21:30 bench")
    hidden = [browser.table.isRowHidden(line) for line in range(2)]
    assert sorted(hidden) == [False, True]
    browser.table.selectRow(hidden.index(False))
    QTest.mouseClick(browser.delete_button, Qt.MouseButton.LeftButton)
    assert browser.question is not None
    assert "213000_telemetry of 2026-11-22" in browser.question.text() + browser.question.informativeText()
    browser.question.reject()
    assert len(list(find_recordings(runs))) == 2
    QTest.mouseClick(browser.delete_button, Qt.MouseButton.LeftButton)
    assert browser.question is not None
    delete = next(one for one in browser.question.buttons() if one.text() == "Delete")
    QTest.mouseClick(delete, Qt.MouseButton.LeftButton)
    wait_for(lambda: browser.table.rowCount() == 1)
    browser.filter.clear()
    browser.table.selectRow(0)
    QTest.mouseClick(browser.open_button, Qt.MouseButton.LeftButton)
    wait_for(lambda: panel.analysis is not None)
    assert panel.source_label.text().startswith("22:00:00 · 1,024 frames")


def test_a_recording_that_goes_on_is_not_deleted(
    window: MainWindow, panel: TelemetryPanel, source: ScriptedSource, runs: Path
):
    folder = record(runs / "2026-11-22" / "213000_telemetry")
    source.change(recording=RecordingState(recording=True, path=str(folder)))
    window.recording_browser.open_list()
    wait_for(lambda: window.recording_browser.table.rowCount() == 1)
    window.recording_browser.table.selectRow(0)
    assert not window.recording_browser.delete_button.isEnabled()


def test_growth_in_words():
    assert describe_growth(RecordingState(), 0) == "no recording yet"
    full = RecordingState(path="/r", written=10, dropped=2, size=3_000_000_000, fault="disk full")
    assert describe_growth(full, 0) == "10 entries · 3.00 GB · 2 dropped · disk full"


def test_nothing_is_recorded_without_a_server(
    window: MainWindow, panel: TelemetryPanel, source: ScriptedSource
) -> None:
    assert panel.record_button.isEnabled()
    source.connected = False
    window.update_timer.tick(force=True)
    assert "server not responding" in panel.record_button.toolTip()
    assert not panel.record_button.isEnabled()


def test_the_wheel_changes_no_field_without_the_focus(panel: TelemetryPanel) -> None:
    panel.seconds.clearFocus()
    place = QPointF(panel.seconds.rect().center())
    turn = QWheelEvent(
        place, QPointF(panel.seconds.mapToGlobal(place.toPoint())), QPoint(), QPoint(0, 120),
        Qt.MouseButton.NoButton, Qt.KeyboardModifier.NoModifier, Qt.ScrollPhase.NoScrollPhase, False,
    )  # fmt: skip
    QApplication.sendEvent(panel.seconds, turn)
    assert panel.seconds.value() == 10
