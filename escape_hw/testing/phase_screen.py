"""Contract checks of phase screens."""

from __future__ import annotations

import math
from dataclasses import asdict
from functools import partial
from typing import Any

from escape_hw.api.phase_screen import ScreenInfo, ScreenState
from escape_hw.errors import SettingRejected
from escape_hw.testing.checks import (
    FULL,
    NORMAL,
    READS,
    Check,
    Factory,
    assert_refused,
    check,
    checks_in,
    checks_up_to,
    open_device,
)
from escape_hw.testing.device import COMMON_CHECKS


@check(READS)
def check_screen_info(factory: Factory) -> None:
    """``info`` is complete."""
    with open_device(factory) as screen:
        info = screen.info
        assert isinstance(info, ScreenInfo), f"info is {type(info).__name__}, not ScreenInfo"
        assert info.model.strip(), "info.model is empty; products need it"
        assert type(info.simulated) is bool, f"info.simulated is {info.simulated!r}, neither true nor false"


@check(READS)
def check_screen_state_is_valid(factory: Factory) -> None:
    """The state is within its ranges."""
    with open_device(factory) as screen:
        state = screen.state
        assert isinstance(state, ScreenState), f"state is {type(state).__name__}, not ScreenState"
        assert screen.n_screens >= 1, f"n_screens is {screen.n_screens}"
        assert 0 <= state.screen < screen.n_screens, f"{state}, but there are {screen.n_screens} screens"
        assert isinstance(state.inserted, bool), f"inserted is {state.inserted!r}, not a bool"
        assert isinstance(state.blocked, bool), f"blocked is {state.blocked!r}, not a bool"
        assert 0 <= state.speed_m_s < math.inf, f"speed_m_s is {state.speed_m_s}"


@check(READS)
def check_screen_refuses_meaningless(factory: Factory) -> None:
    """Invalid values are rejected and change nothing."""
    with open_device(factory) as screen:
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


@check(NORMAL)
def check_screen_set_changes_only_given_fields(factory: Factory) -> None:
    """``set`` changes the given values only, and returns the new state."""
    with open_device(factory) as screen:
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


@check(FULL)
def check_screen_reaches_every_screen(factory: Factory) -> None:
    """Every screen can be selected."""
    with open_device(factory) as screen:
        before = screen.state
        try:
            for k in range(screen.n_screens):
                reached = screen.set(screen=k)
                assert reached.screen == k, f"set(screen={k}) gave {reached}"
                assert screen.state == reached, f"set() returned {reached}, but state is {screen.state}"
        finally:
            screen.set(screen=before.screen)


SCREEN_CHECKS = (*COMMON_CHECKS, *checks_in(globals()))


def screen_checks(max_level: int = 3) -> list[Check]:
    """Checks for phase screens up to a level: 0 at rest, 2 moves the screen in and out, 3 all screens."""
    return checks_up_to(SCREEN_CHECKS, max_level)
