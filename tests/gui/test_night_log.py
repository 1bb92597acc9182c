"""The night log in the window: notes, events, export, trends; alarms are logged."""

from __future__ import annotations

import threading
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from gui_windows import settle, wait_for
from PySide6.QtCore import QCoreApplication, Qt
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QFileDialog
from scripted import ScriptedControl, ScriptedSource

from escape_gui.main_window import MainWindow
from escape_gui.panels.night import NightPanel
from escape_gui.panels.trends import TrendsPanel
from escape_gui.settings import Settings
from escape_gui.views.trends import TRENDS, TrendHistory, hour_ticks, night_medians
from escape_hw.errors import ServerGone
from escape_hw.io.night_log import NightEntry
from escape_hw.io.provenance import format_utc


def entry(
    number: int, kind: str = "event", text: str = "", seconds: float = 0.0, **values: float
) -> NightEntry:
    """An entry of some seconds ago."""
    at = datetime.now(UTC) - timedelta(seconds=seconds)
    return NightEntry(number=number, at_utc=format_utc(at), kind=kind, text=text, values=values)


@pytest.fixture
def panel(make_window, source: ScriptedSource) -> NightPanel:
    source.night = [
        entry(0, text="loop closed on 'escape'"),
        entry(1, "fault", "FAULT: no frame"),
        entry(2, "sample", strehl=40.0),
    ]
    window: MainWindow = make_window((NightPanel,))
    found = window.panels["night"]
    assert isinstance(found, NightPanel)
    return found


def test_a_note_is_typed_and_sent_and_the_field_is_cleared(panel: NightPanel, control: ScriptedControl):
    QTest.keyClicks(panel.note, "clouds from the west")
    QTest.keyClick(panel.note, Qt.Key.Key_Return)
    wait_for(lambda: not panel.note.text())
    assert control.asked[-1] == ("add_note", {"args": ("clouds from the west",)})


def test_a_refused_note_stays_in_the_field(panel: NightPanel, control: ScriptedControl):
    control.refuse = "the server is gone"
    QTest.keyClicks(panel.note, "clouds")
    QTest.mouseClick(panel.add_button, Qt.MouseButton.LeftButton)
    wait_for(lambda: panel.note.isEnabled() and panel.message.text())
    assert panel.note.text() == "clouds"
    assert "the server is gone" in panel.message.text()


def test_a_note_without_an_answer_can_be_sent_again_after_a_reconnection(
    panel: NightPanel, source: ScriptedSource, control: ScriptedControl
):
    go_on = threading.Event()

    def add_note(text: str) -> None:
        go_on.wait(20)
        raise ServerGone("this connection is closed")

    control.add_note = add_note
    QTest.keyClicks(panel.note, "clouds")
    QTest.keyClick(panel.note, Qt.Key.Key_Return)
    assert not panel.note.isEnabled()
    panel.context.session.set_source(source, again := ScriptedControl())
    go_on.set()
    wait_for(lambda: panel.note.isEnabled())
    assert panel.note.text() == "clouds"
    assert "The note is not in the log" in panel.message.text()
    QTest.keyClick(panel.note, Qt.Key.Key_Return)
    wait_for(lambda: not panel.note.text())
    assert again.asked == [("add_note", {"args": ("clouds",)})]


def test_events_are_shown_once_and_filtered(panel: NightPanel, source: ScriptedSource):
    assert panel.text.toPlainText().count("loop closed") == 1
    assert "no frame" in panel.text.toPlainText()
    source.night.append(entry(3, "note", "<i>wind</i>"))
    panel.tick(source)
    assert "<i>wind</i>" in panel.text.toPlainText()
    panel.filter.setCurrentText("Faults and alarms")
    assert panel.text.toPlainText().splitlines()[0].endswith("FAULT no frame")
    assert "wind" not in panel.text.toPlainText()


def test_the_log_is_exported_with_figures(panel: NightPanel, monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    target = tmp_path / "night.html"
    monkeypatch.setattr(QFileDialog, "getSaveFileName", lambda *_: (str(target), ""))
    monkeypatch.setattr("escape_gui.panels.night.runs_folder", lambda session: tmp_path)
    QTest.mouseClick(panel.export_button, Qt.MouseButton.LeftButton)
    wait_for(lambda: panel.message.text().startswith("Written"))
    content = target.read_text()
    assert "loop closed" in content
    assert "<svg" in content


def test_the_window_in_control_logs_its_alarms(make_window, source: ScriptedSource, control: ScriptedControl):
    window: MainWindow = make_window((NightPanel,), Settings(alarms={"strehl": 90.0}))
    for _ in range(6):
        source.change()
        window.refresh()
    wait_for(lambda: "add_note" in control.verbs)
    ((text,), kind) = next((call["args"], call["kind"]) for verb, call in control.asked if verb == "add_note")
    assert text.startswith("Strehl ratio 36.5 %, below 90 %")
    assert kind == "alarm"
    window.alarms.acknowledge()
    wait_for(lambda: control.verbs.count("add_note") == 2)


def test_trends_are_drawn_over_hours_and_over_nights(
    make_window, source: ScriptedSource, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    monkeypatch.setattr("escape_gui.panels.trends.runs_folder", lambda session: tmp_path)
    # One night, also at noon, when the next one begins.
    monkeypatch.setattr("escape_gui.panels.trends.night_of", lambda time: "2026-11-22")
    window: MainWindow = make_window((TrendsPanel,))
    panel = window.panels["trends"]
    assert isinstance(panel, TrendsPanel)
    assert panel.shows_placeholder
    source.night = [
        entry(k, "sample", seconds=600 - 10 * k, strehl=40.0, strength=22.0, r0_m=2.2e-4) for k in range(50)
    ]
    source.night.append(entry(50, "note", "clouds", seconds=60))
    window.update_timer.tick(force=True)
    QCoreApplication.processEvents()
    assert not panel.shows_placeholder
    assert panel.readouts["strength"].text == "22"
    assert panel.readouts["r0_m"].text == "0.22 mm"
    assert panel.missing.text() == "not measured: registration, optical gain"
    numbers = [plot.getAxis("left").style["showValues"] for plot in panel.plot._plots]
    assert numbers == [True, True, False, False], "an axis without data has no numbers"
    assert [one.name for one in panel.export_arrays()] == ["strehl", "strength"]
    panel.span.choose("Nights")
    wait_for(lambda: panel.missing.text().startswith("1 nights"))
    window.context.theme.set_palette("light")
    panel.span.choose("1 h")
    window.update_timer.tick(force=True)
    settle()


def test_a_low_axis_has_no_more_numbers_than_fit(make_window) -> None:
    panel = make_window((TrendsPanel,)).panels["trends"]
    axis = panel.plot._plots[0].getAxis("left")
    assert [len(axis.tickValues(0.4, 1.4, size)[0][1]) for size in (400.0, 40.0)] == [5, 3]


def test_the_newest_entry_is_shown_until_the_operator_scrolls_up(make_window, source: ScriptedSource) -> None:
    window: MainWindow = make_window((NightPanel,))
    panel = window.panels["night"]
    bar = panel.text.verticalScrollBar()
    window.resize(900, 300)
    source.night = [entry(k, "note", f"{k} some words about the wind and the clouds") for k in range(40)]
    panel.tick(source)
    settle()
    # Narrower: the lines wrap.
    window.resize(340, 300)
    settle()
    panel.tick(source)
    assert bar.maximum() > 0
    assert bar.value() == bar.maximum()
    bar.triggerAction(bar.SliderAction.SliderToMinimum)
    source.night.append(entry(40, "note", "new"))
    panel.tick(source)
    assert bar.value() == 0


def test_gaps_and_relative_values_of_trends():
    history = TrendHistory()
    history.add(entry(k, "sample", seconds=s, strehl=40.0 + k) for k, s in enumerate((900, 890, 100, 90)))
    history.add([entry(9, "sample", seconds=50, shift_x=-16.0, shift_x_sigma=0.5), entry(10, shift_x=-15.0)])
    strehl = history.curve(TRENDS[0], "strehl", 0.0)
    np.testing.assert_array_equal(strehl[1], [40, 41, np.nan, 42, 43])
    shift = history.curve(TRENDS[2], "shift_x", 0.0)
    np.testing.assert_array_equal(shift[1], [0, 1])
    assert shift[2, 0] == 0.5
    points = night_medians(
        {"2026-11-21": {"shift_x": (-16, -17, -15)}, "2026-11-22": {"shift_x": (-14, -15, -13)}},
        TRENDS[2],
        "shift_x",
    )
    np.testing.assert_array_equal(points, [[0, 1], [0, 2], [1, 1]])
    assert 4 <= len(hour_ticks(0.0, 43200.0)) <= 8


def test_a_note_without_a_server_stays_and_says_so(panel: NightPanel, source: ScriptedSource) -> None:
    source.connected = False
    panel.tick(source)
    assert not panel.add_button.isEnabled()
    assert "server not responding" in panel.add_button.toolTip()
    panel.context.session.set_source(source, None)
    QTest.keyClicks(panel.note, "clouds")
    QTest.keyClick(panel.note, Qt.Key.Key_Return)
    assert panel.note.text() == "clouds"
    assert panel.message.text() == "The note is not in the log: there is no server"
