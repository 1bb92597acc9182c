"""Every check on adaptive secondaries fails on one that violates only the checked rule."""

from __future__ import annotations

import contextlib
from dataclasses import replace
from typing import Any

import numpy as np
from broken import Broken

from escape_hw.api.adaptive_secondary import AdaptiveSecondary, ShellState
from escape_hw.api.mirror import DeformableMirror
from escape_hw.errors import DeviceError
from escape_hw.testing.reference_devices import IdealSecondary


def sticks_on_the_way_down(self: Any, state: ShellState) -> None:
    if state is not ShellState.OFF:
        IdealSecondary._step(self, state)


def health_of_another_state(self: Any) -> Any:
    return replace(IdealSecondary._health(self), state=ShellState.RUNNING)


def always_follows(self: Any, command: Any) -> Any:
    with contextlib.suppress(DeviceError):
        return DeformableMirror.send(self, command)
    self._guard.set_last(np.asarray(command, dtype=float))
    return None


def keeps_its_shape(self: Any, state: ShellState) -> None:
    while self._stands is not state:
        ladder = [*ShellState]
        step = 1 if ladder.index(state) > ladder.index(self._stands) else -1
        self._stands = ladder[ladder.index(self._stands) + step]


def goes_anywhere(self: Any, state: ShellState) -> None:
    if state is not ShellState.FAULT:
        AdaptiveSecondary.go_to(self, state)


def half_of_them(self: Any) -> Any:
    self.require_open()
    return np.zeros(3)


def in_metres_per_stroke(self: Any) -> Any:
    return np.full(self.info.n_act, 1e4)


def no_gap(self: Any) -> Any:
    return replace(IdealSecondary._health(self), gap_m=float("nan"))


def drives_regardless(self: Any, command: Any) -> Any:
    return self._send_to_shell(command)


def hides_the_way_out(self: Any, fault: str) -> DeviceError:
    return DeviceError(self.name, "broken")


def recovers_always(self: Any) -> None:
    self.require_open()
    self._recover()


def stays_afloat(self: Any) -> None:
    DeformableMirror._before_close(self)


DEFECTS: list[tuple[str, str, dict[str, Any]]] = [
    ("sticks", "secondary_reaches_every_state", {"_step": sticks_on_the_way_down}),
    ("health elsewhere", "secondary_reaches_every_state", {"_health": health_of_another_state}),
    ("follows asleep", "secondary_follows_commands_only_when_running", {"send": always_follows}),
    ("remembers", "secondary_is_flat_after_rest", {"go_to": keeps_its_shape}),
    ("ignores a fault", "secondary_refuses_fault_as_target", {"go_to": goes_anywhere}),
    ("few positions", "secondary_measures_every_actuator", {"measured_positions": half_of_them}),
    ("metres", "secondary_measures_every_actuator", {"_measure_positions": in_metres_per_stroke}),
    ("no gap", "secondary_reports_health", {"_health": no_gap}),
    ("drives regardless", "secondary_latches_faults", {"_send": drives_regardless}),
    ("no way out", "secondary_latches_faults", {"_fault_error": hides_the_way_out}),
    ("recovers always", "secondary_recovers_only_from_faults", {"recover": recovers_always}),
    ("closes afloat", "secondary_rests_when_closed", {"_before_close": stays_afloat}),
]
BROKEN: list[Broken] = [(name, IdealSecondary, check, broken) for name, check, broken in DEFECTS]
