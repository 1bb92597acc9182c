"""Every action of the table: its effect when triggered, and the reason when it is unavailable."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from PySide6.QtWidgets import QFileDialog
from pytestqt.qtbot import QtBot
from scripted import ScriptedControl, ScriptedSource, running

from escape_gui.main_window import MainWindow
from escape_gui.window.actions import ACTIONS, MENUS, Action
from escape_hw.io.fits import file as fits_file
from escape_hw.remote.state import ActiveRun, FaultState, Lease, LoopState, Phase

RUN = ActiveRun(id=3, name="escape", arguments={}, total=1000)
FAULT = FaultState(reason="no frames", at_utc="2026-11-21T21:00:00")
SOMEBODY = Lease(
    client="fedcba9876543210", name="ben", host="control", pid=3, since_utc="2026-11-21T20:00:00"
)


class Stage:
    """Objects that the checks use."""

    def __init__(
        self, window: MainWindow, source: ScriptedSource, control: ScriptedControl, folder: Path, bot: QtBot
    ) -> None:
        self.window, self.source, self.control, self.folder, self.bot = window, source, control, folder, bot

    def asked(self, verb: str, **arguments: object) -> None:
        """The server received exactly this request."""
        self.bot.waitUntil(lambda: self.control.asked == [(verb, arguments)], timeout=5000)

    def refused(self, name: str) -> None:
        """The chosen file is not a recorded run, and a notification reports it."""
        self.bot.waitUntil(lambda: bool(self.window.notifications.notifications), timeout=5000)
        assert name in self.window.notifications.notifications[-1].text

    def saved(self, ending: str) -> Path:
        """One file was saved."""
        (path,) = self.folder.glob(f"*.{ending}")
        assert path.stat().st_size > 100
        return path


def _saved_fits(stage: Stage) -> None:
    hdus, _ = fits_file.read(stage.saved("fits"), "SCREEN")
    assert hdus["FRAME"].data.shape == (400, 400)


def _saved_csv(stage: Stage) -> None:
    frame = stage.folder / "chosen_frame.csv"
    assert len(frame.read_text().splitlines()) == 401


def _workspace(name: str) -> Callable[[Stage], None]:
    def check(stage: Stage) -> None:
        assert stage.window.workspace.name == name
        seen = {key for key, dock in stage.window.docks.items() if dock.isVisible()}
        assert seen == set(stage.window.workspace.panels) & set(stage.window.docks)

    return check


def _scale(sign: int) -> Callable[[Stage], None]:
    def check(stage: Stage) -> None:
        scale = stage.window.context.theme.scale
        assert (scale > 1) - (scale < 1) == sign

    return check


def _focus(stage: Stage) -> None:
    assert stage.window.focused_panel() is not None


def _reset(stage: Stage) -> None:
    assert stage.window.docks["log"].isVisible()


#: Check of the effect of each action. The test of an action without a check fails.
CHECKS: dict[str, Callable[[Stage], None]] = {
    "open_product": lambda s: s.refused("chosen.fits"),
    "runs": lambda s: _is(s.window.run_browser.isVisible()),
    "open_run": lambda s: s.refused("saved"),
    "save_png": lambda s: s.saved("png"),
    "save_csv": _saved_csv,
    "save_fits": _saved_fits,
    "save_window": lambda s: s.saved("png"),
    "quit": lambda s: s.bot.waitUntil(lambda: s.window.close_question is not None),
    "workspace_align": _workspace("align"),
    "workspace_calibrate": _workspace("calibrate"),
    "workspace_operate": _workspace("operate"),
    "reset_layout": _reset,
    "next_panel": _focus,
    "previous_panel": _focus,
    "freeze": lambda s: _is(s.window.update_timer.frozen),
    "theme": lambda s: _is(s.window.context.theme.palette_name == "light"),
    "larger": _scale(+1),
    "smaller": _scale(-1),
    "normal": _scale(0),
    "open_loop": lambda s: s.asked("open_loop"),
    "flatten": lambda s: s.asked("flatten"),
    "abort": lambda s: s.asked("abort"),
    "pause": lambda s: s.asked("pause"),
    "take_control": lambda s: s.asked("acquire", take_over=True),
    "give_back": lambda s: s.asked("release"),
    "record": lambda s: s.asked("record", args=(True,)),
    "connect": lambda s: _is(s.window.connect_dialog.isVisible()),
    "alarms": lambda s: _is(s.window.alarm_dialog.isVisible()),
    "acknowledge": lambda s: _is(s.window.alarms.unacknowledged == ()),
    "clear_fault": lambda s: s.asked("clear_fault"),
    "help_panel": lambda s: _is(s.window.overlay.isVisible() and "sensor" in s.window.overlay.page),
    "keys": lambda s: _is("Ctrl+Shift+F" in s.window.overlay.page),
}

#: Changes of the state that an action needs.
SETTINGS: dict[str, Callable[[ScriptedSource], None]] = {
    "abort": lambda s: s.change(active_run=RUN),
    "pause": lambda s: s.change(active_run=RUN),
    "take_control": lambda s: s.change(lease=SOMEBODY),
    "clear_fault": lambda s: s.change(phase=Phase.FAULT, fault=FAULT),
}


def _is(true: bool) -> None:
    assert true


@pytest.mark.parametrize("action", ACTIONS, ids=lambda action: action.name)
def test_every_action_does_what_it_says(
    action: Action,
    small_window: MainWindow,
    source: ScriptedSource,
    control: ScriptedControl,
    tmp_path: Path,
    qtbot: QtBot,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    window = small_window
    folder = tmp_path / "saved"
    folder.mkdir()
    ending = action.name.removeprefix("save_").replace("window", "png")
    monkeypatch.setattr(QFileDialog, "getSaveFileName", lambda *_: (str(folder / f"chosen.{ending}"), ""))
    monkeypatch.setattr(QFileDialog, "getOpenFileName", lambda *_: (str(folder / "chosen.fits"), ""))
    monkeypatch.setattr(QFileDialog, "getExistingDirectory", lambda *_: str(folder))
    (tmp_path / "run").mkdir(mode=0o700)
    for variable in ("XDG_RUNTIME_DIR", "XDG_CONFIG_HOME"):
        monkeypatch.setenv(variable, str(tmp_path / "run"))
    SETTINGS.get(action.name, lambda _: None)(source)
    if action.name == "reset_layout":
        window.docks["log"].close()
    window.panels["camera"].image_view.setFocus()
    window.refresh()
    entry = window.actions_by_name[action.name]
    assert entry.isEnabled(), entry.toolTip()
    assert action.menu in MENUS
    assert entry.toolTip().startswith(action.tip)
    entry.trigger()
    CHECKS[action.name](Stage(window, source, control, folder, qtbot))


@pytest.mark.parametrize(
    ("names", "state", "reason"),
    [
        (("abort", "pause"), {}, "no procedure is running"),
        (("take_control",), {}, "you have control"),
        (("give_back",), {"lease": None}, "you do not have control"),
        (("clear_fault",), {}, "no active fault"),
        (("record", "pause"), {"lease": None}, "take control first"),
        (("record",), {"lease": SOMEBODY}, "ben on control has control"),
    ],
)
def test_an_impossible_action_gives_the_reason(
    names: tuple[str, ...],
    state: dict[str, object],
    reason: str,
    small_window: MainWindow,
    source: ScriptedSource,
) -> None:
    window = small_window
    source.change(**state)
    window.refresh()
    for name in names:
        entry = window.actions_by_name[name]
        assert not entry.isEnabled()
        assert reason in entry.toolTip()


def test_without_a_server_nothing_can_be_asked(small_window: MainWindow, source: ScriptedSource) -> None:
    window = small_window
    asking = [one for one in ACTIONS if one.menu == "&Loop"]
    source.connected = False
    window.refresh()
    assert all("server not responding" in window.actions_by_name[one.name].toolTip() for one in asking)
    window.context.session.set_source(source, None)
    window.refresh()
    assert all("replay of a recorded run" in window.actions_by_name[one.name].toolTip() for one in asking)
    assert not any(window.actions_by_name[one.name].isEnabled() for one in asking)


def test_no_two_actions_share_a_key() -> None:
    keys = [key for one in ACTIONS for key in one.keys]
    assert len(keys) == len(set(keys))


def test_safety_needs_no_lease(small_window: MainWindow, source: ScriptedSource) -> None:
    window = small_window
    source.state = running(lease=SOMEBODY, loop=LoopState(closed=True))
    window.refresh()
    assert window.header.open_button.isEnabled()
    assert window.header.flatten_button.isEnabled()
