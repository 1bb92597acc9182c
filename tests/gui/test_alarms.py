"""Alarms: limits typed into the dialog, raised, heard, acknowledged, and logged."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from PySide6.QtCore import Qt
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QApplication, QDialogButtonBox
from pytestqt.qtbot import QtBot
from scripted import LEASE, ScriptedControl, ScriptedSource

from escape_gui.main_window import MainWindow
from escape_gui.panels.log import LogPanel
from escape_gui.settings import load_settings
from escape_hw.remote.state import ActiveRun, FrameCounters, Illumination, Lease


@pytest.fixture
def window(make_window: Callable[..., MainWindow]) -> MainWindow:
    return make_window((LogPanel,))


@pytest.fixture
def sounds(monkeypatch: pytest.MonkeyPatch) -> list[None]:
    heard: list[None] = []
    monkeypatch.setattr(QApplication, "beep", lambda: heard.append(None))
    return heard


def set_limit(window: MainWindow, name: str, text: str, *, muted: bool = False) -> None:
    """Type a limit into the dialog and press OK."""
    window.actions_by_name["alarms"].trigger()
    dialog = window.alarm_dialog
    box = dialog.limits[name]
    box.setFocus()
    box.selectAll()
    QTest.keyClicks(box, text)
    dialog.muted.setChecked(muted)
    buttons = dialog.findChild(QDialogButtonBox)
    assert buttons is not None
    QTest.mouseClick(buttons.button(QDialogButtonBox.StandardButton.Ok), Qt.MouseButton.LeftButton)


def pass_states(window: MainWindow, source: ScriptedSource, count: int = 6, **changes: object) -> None:
    for _ in range(count):
        source.change(**changes)
        window.refresh()


def test_without_limits_there_is_no_alarm(window: MainWindow, source: ScriptedSource) -> None:
    pass_states(window, source, rates=FrameCounters(lost_frames=10_000))
    assert not window.alarm_banner.isVisible()


@pytest.mark.parametrize(
    ("name", "limit", "changes", "text"),
    [
        ("strehl", "40", {}, "Strehl ratio 36.5 %, below 40 %"),
        ("residual", "30", {}, "Residual 44 nm rms, above 30 nm rms"),
        (
            "lost",
            "100",
            {"rates": FrameCounters(lost_frames=120)},
            "Lost frames 120 frames, above 100 frames",
        ),
        ("saturated", "2", {"illumination": Illumination(saturated=0.05)}, "Saturated pixels 5 %, above 2 %"),
        (
            "drift",
            "25",
            {"active_run": ActiveRun(id=4, name="track", arguments={}, metrics={"drift": 31.4})},
            "Registration drift 31.4 % of a sub-aperture, above 25 %",
        ),
    ],
)
def test_an_alarm_is_raised_heard_and_acknowledged(
    name: str, limit: str, changes: dict[str, object], text: str,
    window: MainWindow, source: ScriptedSource, sounds: list[None], caplog: pytest.LogCaptureFixture,
) -> None:  # fmt: skip
    set_limit(window, name, limit)
    assert not window.alarm_dialog.isVisible()
    pass_states(window, source, 2, **changes)
    assert not window.alarm_banner.isVisible()
    pass_states(window, source, **changes)
    assert text in window.alarm_banner.text.text()
    assert len(sounds) == 1
    assert f"ALARM: {text}" in caplog.text
    QTest.mouseClick(window.alarm_banner.button, Qt.MouseButton.LeftButton)
    window.refresh()
    assert not window.alarm_banner.isVisible()
    assert f"acknowledged: {text}" in caplog.text


def test_an_alarm_stays_after_its_reason_has_passed(window: MainWindow, source: ScriptedSource) -> None:
    set_limit(window, "lost", "100", muted=True)
    pass_states(window, source, rates=FrameCounters(lost_frames=120))
    pass_states(window, source, rates=FrameCounters(lost_frames=0))
    assert window.alarm_banner.isVisible()
    QTest.keyClick(window, Qt.Key.Key_K, Qt.KeyboardModifier.ControlModifier)
    pass_states(window, source, rates=FrameCounters(lost_frames=0))
    pass_states(window, source, rates=FrameCounters(lost_frames=120))
    assert window.alarm_banner.isVisible(), "the next alarm is raised again"


def test_a_muted_alarm_is_not_heard(window: MainWindow, source: ScriptedSource, sounds: list[None]) -> None:
    set_limit(window, "residual", "30", muted=True)
    pass_states(window, source)
    assert window.alarm_banner.isVisible()
    assert sounds == []


def test_a_limit_out_of_range_is_reported(window: MainWindow) -> None:
    set_limit(window, "strehl", "140")
    assert "Strehl ratio: 140 is out of range: 0 to 100" in window.alarm_dialog.message.text()
    assert window._settings.alarms == {}
    window.alarm_dialog.reject()


def test_the_limits_outlive_a_window_that_is_killed(window: MainWindow) -> None:
    set_limit(window, "residual", "30", muted=True)
    assert window._settings_path is not None
    settings, _ = load_settings(window._settings_path)
    assert settings.alarms == {"residual": 30.0}
    assert settings.alarms_muted


@pytest.mark.parametrize(
    ("lease", "logged"),
    [
        (LEASE, True),
        (None, True),
        (LEASE.model_copy(update={"client": "f" * 16, "name": "notebook"}), True),
        (LEASE.model_copy(update={"client": "f" * 16, "name": "escape gui"}), False),
    ],
)
def test_an_alarm_is_logged_unless_another_window_does(
    lease: Lease | None, logged: bool, window: MainWindow, source: ScriptedSource,
    control: ScriptedControl, qtbot: QtBot,
) -> None:  # fmt: skip
    source.change(lease=lease)
    set_limit(window, "residual", "30", muted=True)
    pass_states(window, source)
    QTest.keyClick(window, Qt.Key.Key_K, Qt.KeyboardModifier.ControlModifier)
    qtbot.waitUntil(lambda: window.context.session._pending == 0)
    assert control.verbs == ["add_note", "add_note"] * logged
