"""Every general check fails on a device that violates only the checked rule."""

from __future__ import annotations

import time
from typing import Any

from broken import Broken

from escape_hw.errors import DeviceError, NotOpen
from escape_hw.testing.reference_devices import IdealPhaseScreen, RecordingMirror


def opens_itself(self: Any) -> None:
    IdealPhaseScreen.__init__(self)
    self._is_open = True


def refuses_to_reopen(self: Any) -> None:
    self.opened = getattr(self, "opened", 0) + 1
    if self.opened > 1:
        raise DeviceError(self.name, "only once")


def swallows(self: Any, *error: Any) -> bool:
    self.close()
    return True


def sets_anyway(self: Any, **change: Any) -> Any:
    return self._state if not self.is_open else IdealPhaseScreen.set(self, **change)


def unnamed_not_open(self: Any) -> None:
    if not self._is_open:
        raise NotOpen("device", "not open")


def falling_clock(self: Any) -> int:
    return -time.monotonic_ns()


BROKEN: list[Broken] = [
    ("opens itself", IdealPhaseScreen, "construction_does_not_connect", {"__init__": opens_itself}),
    ("finaliser", IdealPhaseScreen, "construction_does_not_connect", {"__del__": lambda self: None}),
    (
        "no name",
        IdealPhaseScreen,
        "construction_does_not_connect",
        {"__init__": lambda self: IdealPhaseScreen.__init__(self, "")},
    ),
    (
        "overrides send",
        RecordingMirror,
        "final_methods_are_not_overridden",
        {"send": lambda self, c: self._send(c)},
    ),
    ("opens once", IdealPhaseScreen, "open_and_close_repeat", {"_open": refuses_to_reopen}),
    ("swallows errors", IdealPhaseScreen, "context_manager", {"__exit__": swallows}),
    ("works while closed", IdealPhaseScreen, "refuses_use_unless_open", {"set": sets_anyway}),
    ("does not say who", IdealPhaseScreen, "refuses_use_unless_open", {"require_open": unnamed_not_open}),
    ("clock runs backwards", IdealPhaseScreen, "clock_is_monotonic", {"now_ns": falling_clock}),
    (
        "clock in seconds",
        IdealPhaseScreen,
        "clock_is_monotonic",
        {"now_ns": lambda self: time.monotonic()},
    ),
]
