"""Contract checks of phase screens."""

from __future__ import annotations

import math
from dataclasses import asdict
from functools import partial
from typing import Any

from escape_hw.api.phase_screen import PhaseScreen, ScreenInfo, ScreenState
from escape_hw.errors import SettingRejected
from escape_hw.testing.checks import FULL, NORMAL, READS, assert_identified, assert_refused, check


@check(PhaseScreen, READS)
def check_screen_info(screen: PhaseScreen) -> None:
    """``info`` is complete."""
    assert_identified(screen.info, ScreenInfo)


@check(PhaseScreen, READS)
def check_screen_state_is_valid(screen: PhaseScreen) -> None:
    """The state is within its ranges."""
    state = screen.state
    assert isinstance(state, ScreenState), f"state is {type(state).__name__}, not ScreenState"
    assert screen.n_screens >= 1, f"n_screens is {screen.n_screens}"
    assert 0 <= state.screen < screen.n_screens, f"{state}, but there are {screen.n_screens} screens"
    assert isinstance(state.inserted, bool), f"inserted is {state.inserted!r}, not a bool"
    assert isinstance(state.blocked, bool), f"blocked is {state.blocked!r}, not a bool"
    assert 0 <= state.speed_m_s < math.inf, f"speed_m_s is {state.speed_m_s}"


@check(PhaseScreen, READS)
def check_screen_refuses_meaningless(screen: PhaseScreen) -> None:
    """Invalid values are rejected and change nothing."""
    before = screen.state
    wrong: list[dict[str, Any]] = [{"screen": k} for k in (-1, screen.n_screens, 0.5, True)]
    wrong += [{"speed_m_s": v} for v in (-1.0, math.nan, math.inf)]
    wrong += [
        {"inserted": "yes"},
        {"blocked": 1},
        {"screen": screen.n_screens, "inserted": not before.inserted},
    ]
    for change in wrong:
        assert_refused(screen, SettingRejected, f"set({change})", partial(screen.set, **change))
        assert screen.state == before, f"set({change}) was rejected, but the state changed"


@check(PhaseScreen, NORMAL)
def check_screen_set_changes_only_given_fields(screen: PhaseScreen) -> None:
    """``set`` changes the given values only, and returns the new state."""
    before = screen.state
    try:
        assert screen.set() == before, "set() without arguments changed the state"
        for inserted in (False, True):
            answer = screen.set(inserted=inserted)
            assert answer == screen.state, f"set() returned {answer}, but state is {screen.state}"
            assert answer.inserted is inserted, f"set(inserted={inserted}) gave {answer}"
            assert answer.screen == before.screen, "set(inserted=...) changed the screen"
            assert answer.speed_m_s == before.speed_m_s, "set(inserted=...) changed the speed"
        for blocked in (True, False):
            answer = screen.set(blocked=blocked)
            assert answer.blocked is blocked, f"set(blocked={blocked}) gave {answer}"
            assert answer.screen == before.screen, "set(blocked=...) changed the screen"
        still = screen.set(speed_m_s=0.0)
        assert still.speed_m_s == 0.0, f"set(speed_m_s=0) gave {still}"
        assert still.screen == before.screen, "set(speed_m_s=...) changed the screen"
    finally:
        screen.set(**asdict(before))


@check(PhaseScreen, FULL)
def check_screen_reaches_every_screen(screen: PhaseScreen) -> None:
    """Every screen can be selected."""
    before = screen.state
    try:
        for k in range(screen.n_screens):
            reached = screen.set(screen=k)
            assert reached.screen == k, f"set(screen={k}) gave {reached}"
            assert screen.state == reached, f"set() returned {reached}, but state is {screen.state}"
    finally:
        screen.set(screen=before.screen)
