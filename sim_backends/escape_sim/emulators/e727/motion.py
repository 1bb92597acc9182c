"""Motion commands of the emulated controller: servo, volts, targets, auto-zero, stop, and their queries."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from escape_sim.emulators.e727.gcs import GcsCommandError, group_arguments, parse_integer, parse_number
from escape_sim.emulators.e727.stage import SERVO_S, Hold, Ramp, Wave
from escape_sim.emulators.e727.state import PER_VOLT, VOLTS, ControllerState


class MotionCommands:
    """Handlers of the motion commands on a controller's state."""

    def __init__(self, state: ControllerState) -> None:
        self._state = state

    def queries(self) -> dict[str, Callable[[Sequence[str]], str]]:
        """Handlers of the queries that return one value per axis."""
        state = self._state
        values: dict[str, Callable[[str], float | int | str]] = {
            "SVO?": lambda name: int(state.axes[name].servo),
            "SVA?": lambda name: state.axes[name].volts,
            "VOL?": lambda name: state.position(name) / PER_VOLT,
            "ATZ?": lambda name: int(not state.is_zeroing(name) and state.axes[name].zeroed),
            "MOV?": state.target,
            "POS?": state.position,
            "ONT?": self._on_target,
            "VEL?": lambda name: state.axes[name].velocity,
            "TMN?": lambda name: state.travel(name)[0],
            "TMX?": lambda name: state.travel(name)[1],
            "PUN?": lambda _: "urad",
        }
        return {command: state.per_axis(value) for command, value in values.items()}

    def set_servo(self, args: Sequence[str]) -> None:
        """``SVO axis 0|1``."""
        state = self._state
        for name, text in _require_unique(group_arguments(args, 2)):
            state.axis(name)
            state.require_idle(name)
            on = parse_integer(text)
            if on not in (0, 1):
                raise GcsCommandError(17)
            axis = state.axes[name]
            if on and not axis.zeroed:
                state.report_violation(f"SVO {name} 1 before auto-zero: the sensor has an unknown offset")
            if on != axis.servo:
                state.stage.advance()
                position = state.stage.axes[name].position
                # Switched on, the loop holds the position; switched off, the volts are kept.
                axis.servo, axis.volts = bool(on), position / PER_VOLT
                state.stage.axes[name].trajectory = Hold(position)

    def set_volts(self, args: Sequence[str]) -> None:
        """``SVA axis volts``."""
        state = self._state
        pairs = _axis_values(args)
        for name, value in pairs:
            state.axis(name)
            if state.axes[name].servo:
                raise GcsCommandError(79)
            state.require_idle(name)
            if not VOLTS[0] <= value <= VOLTS[1]:
                raise GcsCommandError(66)
        state.stage.advance()
        for name, value in pairs:
            state.axes[name].volts = value
            state.stage.axes[name].trajectory = Hold(value * PER_VOLT)

    def move(self, args: Sequence[str]) -> None:
        """``MOV axis position``."""
        self._move(_axis_values(args))

    def move_by(self, args: Sequence[str]) -> None:
        """``MVR axis distance``."""
        pairs = _axis_values(args)
        for name, _ in pairs:
            self._state.axis(name)
        self._move([(name, self._state.target(name) + step) for name, step in pairs])

    def _move(self, pairs: Sequence[tuple[str, float]]) -> None:
        state = self._state
        for name, target in pairs:
            state.axis(name)
            state.require_idle(name)
            if not state.axes[name].servo:
                raise GcsCommandError(5)
            low, high = state.travel(name)
            if not low <= target <= high:
                raise GcsCommandError(7)
        now = state.stage.advance()
        for name, target in pairs:
            begin = float(state.stage.axes[name].trajectory.at(np.array([now]))[0])
            step = state.axes[name].velocity * SERVO_S
            state.stage.axes[name].trajectory = Ramp(begin, target, now, step)

    def auto_zero(self, args: Sequence[str]) -> None:
        """``ATZ axis volts|NaN``: sweeps the full range."""
        state = self._state
        for name, text in _require_unique(group_arguments(args, 2)):
            state.axis(name)
            if text.casefold() != "nan" and not VOLTS[0] <= parse_number(text) <= VOLTS[1]:
                raise GcsCommandError(66)
            state.require_idle(name)
            axis = state.axes[name]
            if axis.servo:
                raise GcsCommandError(79)
            state.stage.advance()
            now, steps = state.stage.now, max(1, round(state.settings.auto_zero_s / SERVO_S))
            sweep = np.interp(np.arange(64), [0, 16, 48, 63], [0.0, 1.0, 0.0, 0.0]) * state.settings.travel
            state.stage.axes[name].trajectory = Wave(sweep, now, max(1, steps // 64), cycles=1)
            axis.zero_end_step, axis.zeroed = now + steps, False

    def set_velocity(self, args: Sequence[str]) -> None:
        """``VEL axis velocity``."""
        for name, velocity in _axis_values(args):
            self._state.axis(name)
            if not 0 < velocity <= 1e7:
                raise GcsCommandError(8)
            self._state.axes[name].velocity = velocity

    def halt(self, args: Sequence[str]) -> None:
        """``HLT``, ``STP`` and ``#24``: axes stop at their positions; sets error 10."""
        state = self._state
        state.stage.advance()
        for name in state.axes_of(args):
            state.axes[name].zero_end_step = None
            state.stage.axes[name].trajectory = Hold(state.stage.axes[name].position)
        raise GcsCommandError(10)

    def moving_mask(self) -> int:
        """``#5``: one bit for each axis that moves."""
        state = self._state
        return sum(
            (state.is_zeroing(name) or state.is_wave_driven(name) or not self._is_near_target(name)) << bit
            for bit, name in enumerate(state.axes)
        )

    def _on_target(self, name: str) -> int:
        state = self._state
        near = self._is_near_target(name)
        return int(state.axes[name].servo and near and not state.is_wave_driven(name))

    def _is_near_target(self, name: str) -> bool:
        state = self._state
        deviation = abs(state.position(name) - state.target(name))
        return deviation <= float(state.parameters[name, 0x07000900])


def _axis_values(args: Sequence[str]) -> list[tuple[str, float]]:
    """Pairs of axis and number."""
    return [(name, parse_number(text)) for name, text in _require_unique(group_arguments(args, 2))]


def _require_unique(pairs: Sequence[Sequence[str]]) -> list[Sequence[str]]:
    """The groups; raises error 22 if an axis is named twice."""
    names = [pair[0] for pair in pairs]
    if len(set(names)) < len(names):
        raise GcsCommandError(22)
    return list(pairs)
