"""Controller of the emulated adaptive secondary: state transitions, limits, watchdog, alarms."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.adaptive_secondary import STATE_ORDER, ShellState
from escape_sim.emulators.asm import protocol
from escape_sim.mirror.shell import TRANSITION_S, Shell

#: Alarm limits of the mean gap in metres and of a coil's current in amperes.
GAP_ALARMS_M, CURRENT_ALARM_A = (5e-6, 120e-6), 0.79
#: Consecutive failed checks after which the mirror trips.
CHECKS_TO_TRIP = 3
#: Consecutive skipped commands after which the mirror opens the loop.
MAX_CONSECUTIVE_SKIPS = 100
#: Relative tolerance of the limits for commands in single precision.
_ROUNDING_MARGIN = 1e-6


@dataclass(frozen=True, slots=True)
class AsmLimits:
    """The mirror's own limits in metres of surface from flat, and its time-outs in seconds."""

    max_command_m: float
    max_step_m: float
    hold_s: float
    rest_s: float


class AsmController:
    """Shell, watchdog and limits. Times are monotonic seconds given by the caller.

    Parameters
    ----------
    contaminated
        Actuators that the mirror has taken out of service.
    speed
        Factor by which state transitions are faster than on the real mirror.
    pass_time
        Advances simulated time by seconds; state transitions then end at once.

    Attributes
    ----------
    present_m
        Last shape applied ``(n_act,)``, metres from flat.
    pending_skips
        Number of coming commands that are skipped by a fault.
    last_event
        Why the mirror rested or opened the loop on its own; empty if it did not.
    """

    def __init__(
        self,
        shell: Shell,
        limits: AsmLimits,
        contaminated: Iterable[int],
        *,
        speed: float = 1.0,
        pass_time: Callable[[float], None] | None = None,
    ) -> None:
        self.shell, self.limits, self._speed, self._pass_time = shell, limits, speed, pass_time
        n_act = shell.n_act
        self.flat_m = np.zeros(n_act)
        self.present_m = np.zeros(n_act)
        self.contaminated, self.disabled = set(contaminated), set[int]()
        self.parameters = {"telemetry_hz": 10.0, "gap_alarm_m": GAP_ALARMS_M[1]}
        self.applied = self.skipped = self.consecutive_skips = 0
        self.pending_skips = 0
        self.holding = False
        self.last_event = ""
        self._transition: tuple[ShellState, float] | None = None
        self._failed_checks = 0

    @property
    def out_of_service(self) -> set[int]:
        """Contaminated or disabled actuators."""
        return self.contaminated | self.disabled

    def request_state(self, wanted: ShellState, now: float) -> tuple[int, str]:
        """Start a state transition; returns result code and message."""
        state = self.shell.state
        if state is ShellState.FAULT:
            return protocol.PANIC, self.shell.fault
        if self._transition is not None:
            return protocol.WRONG_STATE, f"in transition to {self._transition[0]}"
        if wanted is state:
            return protocol.APPLIED, "already there"
        if wanted is ShellState.FAULT or abs(STATE_ORDER.index(wanted) - STATE_ORDER.index(state)) != 1:
            return protocol.WRONG_STATE, f"no transition from {state} to {wanted}"
        duration = TRANSITION_S[wanted]
        if self._pass_time is not None:
            self._pass_time(duration)
            duration = 0.0
        self._transition = (wanted, now + duration / self._speed)
        self._finish_transition_if_due(now)
        return protocol.APPLIED, ""

    def _finish_transition_if_due(self, now: float) -> None:
        if self._transition is not None and now >= self._transition[1]:
            self._finish_transition(self._transition[0])
            self.last_event = ""

    def _finish_transition(self, state: ShellState) -> None:
        self._transition, self.consecutive_skips, self.holding = None, 0, False
        if state is not ShellState.RUNNING:
            self.present_m = np.zeros(self.shell.n_act)
        self.shell.finish_transition(state, (self.flat_m + self.present_m) / self.shell.stroke_m)

    def rest_autonomously(self, reason: str) -> None:
        """Rest on the mirror's own initiative."""
        self.last_event = reason
        self._finish_transition(ShellState.RESTED)

    def trip(self, reason: str) -> None:
        """Coils off; a latched fault."""
        self._transition, self.holding = None, False
        self.present_m = np.zeros(self.shell.n_act)
        self.shell.trip(reason)

    def recover(self) -> None:
        """End a fault whose cause has gone."""
        if self.shell.state is ShellState.FAULT and not self.shell.excess_a:
            self._failed_checks = 0
            self.shell.recover()

    def command(self, metres: NDArray[np.float32], absolute: bool) -> tuple[int, int]:
        """Apply or skip a finite shape ``(n_act,)``; returns result code and number of changed values."""
        wanted = metres.astype(np.float64)
        if absolute:
            wanted -= self.flat_m
        out_of_service_moved = [i for i in self.out_of_service if wanted[i] != 0]
        wanted[out_of_service_moved] = 0.0
        too_far = np.abs(wanted).max() > self.limits.max_command_m * (1 + _ROUNDING_MARGIN)
        too_fast = np.abs(wanted - self.present_m).max() > self.limits.max_step_m * (1 + _ROUNDING_MARGIN)
        if too_far or too_fast or self.pending_skips:
            self.pending_skips = max(0, self.pending_skips - 1)
            return self._count_skip(), 0
        self.consecutive_skips = 0
        self.applied += 1
        self.present_m = wanted
        self.shell.drive((self.flat_m + wanted) / self.shell.stroke_m)
        return (protocol.CLIPPED if out_of_service_moved else protocol.APPLIED), len(out_of_service_moved)

    def _count_skip(self) -> int:
        """Count a skipped command; the last shape is kept."""
        self.skipped += 1
        self.consecutive_skips += 1
        if self.consecutive_skips >= MAX_CONSECUTIVE_SKIPS:
            self.last_event = f"{MAX_CONSECUTIVE_SKIPS} commands skipped in a row"
            self._finish_transition(ShellState.SET)
        return protocol.SKIPPED

    def tick(self, now: float, since_last_frame_s: float) -> str:
        """Check watchdog and alarms; returns the fault if one was found.

        ``since_last_frame_s`` is the time since the owner's last valid frame.
        """
        self._finish_transition_if_due(now)
        if self.shell.state is ShellState.RUNNING:
            self.holding = since_last_frame_s > self.limits.hold_s
            if since_last_frame_s > self.limits.rest_s:
                self.rest_autonomously(f"the watchdog rested it: no frame for {self.limits.rest_s:g} s")
        return self._check_alarms()

    def _check_alarms(self) -> str:
        if not self.shell.is_floating:
            return ""
        gap, currents = self.shell.gap_m(), self.shell.currents_a()
        worst = int(np.argmax(currents))
        alarm = ""
        if not GAP_ALARMS_M[0] <= gap <= self.parameters["gap_alarm_m"]:
            alarm = f"mean gap of {gap * 1e6:.1f} um"
        elif currents[worst] > CURRENT_ALARM_A:
            alarm = f"coil {worst} over current ({currents[worst]:.2f} A)"
        self._failed_checks = self._failed_checks + 1 if alarm else 0
        if self._failed_checks < CHECKS_TO_TRIP:
            return ""
        self._failed_checks = 0
        self.trip(alarm)
        return alarm

    def positions_m(self) -> NDArray[np.float64]:
        """Measured positions ``(n_act,)`` in metres from flat; NaN where unreadable."""
        return self.shell.measure_positions() * self.shell.stroke_m - self.flat_m

    def flags(self) -> NDArray[np.uint8]:
        """One byte of flags per actuator, see ``docs/devices/asm-link.md``."""
        flags = np.zeros(self.shell.n_act, np.uint8)
        for bits, numbers in (
            (0b1001, self.contaminated),
            (0b10, self.shell.unreadable),
            (0b10000000, self.disabled),
            (0b10000, self.shell.excess_a),
        ):
            flags[sorted(numbers)] |= bits
        return flags

    def set_parameter(self, key: str, value: float) -> str:
        """Set a parameter; returns an error message, empty if it was set."""
        allowed = {"telemetry_hz": (0.1, 100.0), "gap_alarm_m": (60e-6, GAP_ALARMS_M[1])}
        if key not in allowed:
            return f"no parameter {key!r}; there are: {', '.join(sorted(allowed))}"
        low, high = allowed[key]
        if not low <= value <= high:
            return f"{key} must lie in {low:g}..{high:g}"
        self.parameters[key] = value
        return ""
