"""Every check on modulators and screens fails on one that violates only the checked rule."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

from broken import Broken

from escape_hw.api.modulator import ModulatorInfo, ModulatorStatus
from escape_hw.api.phase_screen import ScreenInfo
from escape_hw.errors import SettingRejected
from escape_hw.testing.reference_devices import IdealPhaseScreen, QuantisedModulator


def checks_by_moving(self: Any, want: Any) -> Any:
    self._modulation = QuantisedModulator._check(self, want)
    return self._modulation


def takes_all(self: Any, want: Any) -> Any:
    self.require_open()
    return want


def modulates_as_asked(self: Any, want: Any) -> Any:
    QuantisedModulator.modulate(self, want)
    return want


def forgets_the_rest(self: Any, **change: Any) -> Any:
    self.require_open()
    return IdealPhaseScreen.set(self, **{"screen": 0, **change})


def answers_blindly(self: Any, **change: Any) -> Any:
    return replace(IdealPhaseScreen.set(self, **change), speed_m_s=1.0)


def sticks(self: Any, want: Any) -> None:
    self._state = replace(want, screen=min(want.screen, 2))


def repairs_screen(self: Any, **change: Any) -> Any:
    try:
        return IdealPhaseScreen.set(self, **change)
    except SettingRejected:
        return self._state


def brags(self: Any) -> ModulatorInfo:
    """Claim to reach everywhere."""
    return ModulatorInfo("bragging", "REF-MOD", math.inf, simulated=True)


def tells_of_rest(self: Any) -> ModulatorStatus:
    """Tell that nothing moves, always."""
    return ModulatorStatus(self.info, None)


BROKEN: list[Broken] = [
    ("brags of its reach", QuantisedModulator, "modulator_info", {"info": property(brags)}),
    ("check moves", QuantisedModulator, "modulator_check_changes_nothing", {"_check": checks_by_moving}),
    ("any modulation", QuantisedModulator, "modulator_refuses_meaningless", {"check": takes_all}),
    (
        "modulate lies",
        QuantisedModulator,
        "modulator_reports_actual_modulation",
        {"modulate": modulates_as_asked},
    ),
    ("does not park", QuantisedModulator, "modulator_parks", {"_park": lambda self: None}),
    (
        "closes moving",
        QuantisedModulator,
        "modulator_is_parked_when_closed",
        {"_before_close": lambda self: None},
    ),
    ("status lies", QuantisedModulator, "modulator_status_moves_nothing", {"_status": tells_of_rest}),
    ("nobody's", IdealPhaseScreen, "screen_info", {"info": ScreenInfo(" ", "1", True)}),
    (
        "counts from one",
        IdealPhaseScreen,
        "screen_state_is_valid",
        {"n_screens": property(lambda self: 1)},
    ),
    ("takes anything", IdealPhaseScreen, "screen_refuses_meaningless", {"set": repairs_screen}),
    ("forgets the rest", IdealPhaseScreen, "screen_set_changes_only_given_fields", {"set": forgets_the_rest}),
    ("answers blindly", IdealPhaseScreen, "screen_set_changes_only_given_fields", {"set": answers_blindly}),
    ("sticks", IdealPhaseScreen, "screen_reaches_every_screen", {"_set": sticks}),
]
