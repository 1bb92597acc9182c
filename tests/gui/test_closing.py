"""Closing the window, and control offered by the next one, with key presses and clicks."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from PySide6.QtCore import Qt
from PySide6.QtTest import QTest
from pytestqt.qtbot import QtBot
from scripted import LEASE, ScriptedControl, ScriptedSource

from escape_gui.main_window import MainWindow
from escape_gui.panels.log import LogPanel
from escape_gui.window.closing import CloseQuestion
from escape_hw.remote.state import ActiveRun, Lease, LoopState, Phase, RecordingState

RUN = ActiveRun(id=3, name="docrime", arguments={}, completed=400, total=5000)
OTHER = Lease(client="f" * 16, name="ben", host="control", pid=9, since_utc="2026-11-21T20:00:00")


@pytest.fixture
def window(make_window: Callable[..., MainWindow]) -> MainWindow:
    return make_window((LogPanel,))


@pytest.fixture
def press_quit(window: MainWindow) -> Callable[[], CloseQuestion]:
    """Press Ctrl+Q, and return the question."""

    def press() -> CloseQuestion:
        QTest.keyClick(window, Qt.Key.Key_Q, Qt.KeyboardModifier.ControlModifier)
        assert window.isVisible()
        assert window.close_question is not None
        return window.close_question

    return press


def make_idle(source: ScriptedSource) -> None:
    source.change(phase=Phase.IDLE, loop=LoopState())


def test_closing_while_telemetry_is_recorded_asks(
    source: ScriptedSource, press_quit: Callable[[], CloseQuestion]
) -> None:
    make_idle(source)
    source.change(recording=RecordingState(recording=True, path="/data/telemetry.h5", written=4000))
    question = press_quit()
    assert question.text() == "Telemetry is being recorded."
    assert "The recording goes on" in question.informativeText()


@pytest.mark.parametrize("started", [False, True], ids=["attached", "started"])
@pytest.mark.parametrize(
    ("run", "activity", "future"),
    [
        (RUN, "'docrime' (run 3) is running.", "The procedure goes on to its end"),
        (None, "The loop is closed.", "The loop stays closed"),
    ],
)
def test_closing_while_something_runs_asks_and_can_be_cancelled(
    started: bool, run: ActiveRun | None, activity: str, future: str,
    window: MainWindow, source: ScriptedSource, press_quit: Callable[[], CloseQuestion],
) -> None:  # fmt: skip
    window.started_server = started
    source.change(active_run=run)
    question = press_quit()
    assert question.text() == activity
    assert future in question.informativeText()
    assert "server.unattended_s" in question.informativeText()
    QTest.keyClick(question, Qt.Key.Key_Escape)
    assert window.isVisible()
    assert window.close_question is None


def test_the_window_closes_when_confirmed(
    window: MainWindow, press_quit: Callable[[], CloseQuestion], control: ScriptedControl
) -> None:
    question = press_quit()
    assert question.stop_button is None
    QTest.mouseClick(question.leave_button, Qt.MouseButton.LeftButton)
    assert not window.isVisible()
    assert control.asked == []


@pytest.mark.parametrize("leave", [True, False])
def test_a_server_that_the_window_started_is_left_or_stopped(
    leave: bool, window: MainWindow, source: ScriptedSource
) -> None:
    window.started_server = True
    make_idle(source)
    window.close()
    question = window.close_question
    assert question is not None
    assert question.text() == "Nothing is running."
    QTest.mouseClick(question.leave_button if leave else question.stop_button, Qt.MouseButton.LeftButton)
    assert not window.isVisible()
    assert window.leave_server is leave


def test_the_question_states_a_limit_for_runs(
    source: ScriptedSource, press_quit: Callable[[], CloseQuestion]
) -> None:
    source.change(active_run=RUN, unattended_limit_s=30.0)
    assert "aborted after 30 s without an operator" in press_quit().informativeText()


def test_an_observer_is_told_who_has_control(
    source: ScriptedSource, press_quit: Callable[[], CloseQuestion]
) -> None:
    source.change(lease=OTHER)
    assert "ben on control has control" in press_quit().informativeText()


def test_an_idle_window_closes_at_once(window: MainWindow, source: ScriptedSource) -> None:
    make_idle(source)
    window.close()
    assert not window.isVisible()


def test_a_signal_closes_without_a_question_and_leaves_a_busy_server(window: MainWindow) -> None:
    window.started_server = True
    window.close_without_question()
    assert not window.isVisible()
    assert window.leave_server


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"lease": None}, "No operator has control; the loop stays closed"),
        ({"lease": None, "active_run": RUN}, "'docrime' (run 3) goes on"),
        (
            {"lease": None, "active_run": RUN, "unattended_limit_s": 30.0, "unattended_for_s": 12.0},
            "'docrime' (run 3) is aborted in 18 s",
        ),
        (
            {"lease": OTHER.model_copy(update={"silent_s": 3.4, "expires_in_s": 1.6})},
            "ben on control has not responded for 3 s and loses control in 2 s",
        ),
    ],
    ids=["loop", "run", "run with limit", "silent holder"],
)
def test_control_is_offered_with_a_button(
    changes: dict[str, object], text: str, window: MainWindow, source: ScriptedSource,
    control: ScriptedControl, qtbot: QtBot,
) -> None:  # fmt: skip
    banner = window.control_banner
    assert not banner.isVisible()
    source.change(**changes)
    window.update_timer.tick(force=True)
    assert banner.isVisible()
    assert text in banner.text.text()
    QTest.mouseClick(banner.button, Qt.MouseButton.LeftButton)
    qtbot.waitUntil(lambda: control.verbs == ["acquire"])
    source.change(lease=LEASE)
    window.update_timer.tick(force=True)
    assert not banner.isVisible()


def test_control_is_not_offered_while_somebody_uses_it(window: MainWindow, source: ScriptedSource) -> None:
    source.change(lease=OTHER.model_copy(update={"silent_s": 1.9, "expires_in_s": 3.1}))
    window.update_timer.tick(force=True)
    assert not window.control_banner.isVisible()
