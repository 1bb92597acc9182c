"""Commands of the emulated controller that move axes, one place after the other, or ask where they are."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from escape_sim.emulators.e727.gcs import GcsError, group_arguments, items, number, parse_integer
from escape_sim.emulators.e727.stage import SERVO_S, Hold, Ramp, Wave
from escape_sim.emulators.e727.state import PER_VOLT, VOLTS, ControllerState


class MotionCommands:
    """Servo, volts, targets, auto-zero and stopping.

    Parameters
    ----------
    state
        The controller's.
    """

    def __init__(self, state: ControllerState) -> None:
        self._state = state

    def servo(self, args: Sequence[str]) -> None:
        """``SVO axis 0|1``."""
        state = self._state
        for name, text in _require_unique(group_arguments(args, 2)):
            state.axis(name)
            state.require_idle(name)
            on = parse_integer(text)
            if on not in (0, 1):
                raise GcsError(17)
            axis = state.axes[name]
            if on and not axis.zeroed:
                state.report_violation(
                    f"SVO {name} 1 before auto-zero: the sensor is off by an unknown amount"
                )
            if on != axis.servo:
                state.stage.advance()
                here = state.stage.axes[name].position
                # Switched on, the loop holds what is; switched off, the volts stay as they are.
                axis.servo, axis.volts = bool(on), here / PER_VOLT
                state.stage.axes[name].trajectory = Hold(here)

    def volts(self, args: Sequence[str]) -> None:
        """``SVA axis volts``."""
        state = self._state
        pairs = [(name, number(text)) for name, text in _require_unique(group_arguments(args, 2))]
        for name, value in pairs:
            state.axis(name)
            if state.axes[name].servo:
                raise GcsError(79)
            state.require_idle(name)
            if not VOLTS[0] <= value <= VOLTS[1]:
                raise GcsError(66)
        state.stage.advance()
        for name, value in pairs:
            state.axes[name].volts = value
            state.stage.axes[name].trajectory = Hold(value * PER_VOLT)

    def move(self, args: Sequence[str]) -> None:
        """``MOV axis place``."""
        self._move([(name, number(text)) for name, text in _require_unique(group_arguments(args, 2))])

    def move_by(self, args: Sequence[str]) -> None:
        """``MVR axis distance``."""
        pairs = [(name, number(text)) for name, text in _require_unique(group_arguments(args, 2))]
        for name, _ in pairs:
            self._state.axis(name)
        self._move([(name, self._state.target(name) + step) for name, step in pairs])

    def _move(self, pairs: Sequence[tuple[str, float]]) -> None:
        state = self._state
        for name, place in pairs:
            state.axis(name)
            state.require_idle(name)
            if not state.axes[name].servo:
                raise GcsError(5)
            low, high = state.travel(name)
            if not low <= place <= high:
                raise GcsError(7)
        now = state.stage.advance()
        for name, place in pairs:
            here = float(state.stage.axes[name].trajectory.at(np.array([now]))[0])
            state.stage.axes[name].trajectory = Ramp(here, place, now, state.axes[name].velocity * SERVO_S)

    def auto_zero(self, args: Sequence[str]) -> None:
        """``ATZ axis volts|NaN``: sweeps the full range."""
        state = self._state
        for name, text in _require_unique(group_arguments(args, 2)):
            state.axis(name)
            if text.casefold() != "nan" and not VOLTS[0] <= number(text) <= VOLTS[1]:
                raise GcsError(66)
            state.require_idle(name)
            axis = state.axes[name]
            if axis.servo:
                raise GcsError(79)
            state.stage.advance()
            now, steps = state.stage.now, max(1, round(state.settings.auto_zero_s / SERVO_S))
            sweep = np.interp(np.arange(64), [0, 16, 48, 63], [0.0, 1.0, 0.0, 0.0]) * state.settings.travel
            state.stage.axes[name].trajectory = Wave(sweep, now, max(1, steps // 64), cycles=1)
            axis.zero_end_step, axis.zeroed = now + steps, False

    def velocity(self, args: Sequence[str]) -> None:
        """``VEL axis velocity``."""
        for name, text in _require_unique(group_arguments(args, 2)):
            self._state.axis(name)
            if not 0 < number(text) <= 1e7:
                raise GcsError(8)
            self._state.axes[name].velocity = number(text)

    def halt(self, args: Sequence[str]) -> None:
        """``HLT``, ``STP`` and ``#24``: everything stops where it is, and the error says so."""
        state = self._state
        state.stage.advance()
        for name in state.axes_of(args):
            state.axes[name].zero_end_step = None
            state.stage.axes[name].trajectory = Hold(state.stage.axes[name].position)
        raise GcsError(10)

    # ------------------------------------------------------------------ questions
    def is_zeroed(self, args: Sequence[str]) -> str:
        """``ATZ?``."""
        names = self._state.axes_of(args)
        return items(
            {name: int(not self._state.is_zeroing(name) and self._state.axes[name].zeroed) for name in names}
        )

    def on_target(self, args: Sequence[str]) -> str:
        """``ONT?``."""
        state = self._state
        on_target_by_axis = {}
        for name in state.axes_of(args):
            deviation = abs(state.position(name) - state.target(name))
            near = deviation <= float(state.parameters[name, 0x07000900])
            on_target_by_axis[name] = int(state.axes[name].servo and near and not state.is_wave_driven(name))
        return items(on_target_by_axis)

    def positions(self, args: Sequence[str]) -> str:
        """``POS?``."""
        return items({name: self._state.position(name) for name in self._state.axes_of(args)})

    def targets(self, args: Sequence[str]) -> str:
        """``MOV?``."""
        return items({name: self._state.target(name) for name in self._state.axes_of(args)})

    def servos(self, args: Sequence[str]) -> str:
        """``SVO?``."""
        return items({name: int(self._state.axes[name].servo) for name in self._state.axes_of(args)})

    def voltages(self, args: Sequence[str]) -> str:
        """``VOL?``: volts at the piezos now."""
        state = self._state
        return items({name: state.position(name) / PER_VOLT for name in state.axes_of(args)})

    def commanded_volts(self, args: Sequence[str]) -> str:
        """``SVA?``: volts as commanded."""
        return items({name: self._state.axes[name].volts for name in self._state.axes_of(args)})

    def velocities(self, args: Sequence[str]) -> str:
        """``VEL?``."""
        return items({name: self._state.axes[name].velocity for name in self._state.axes_of(args)})

    def lower(self, args: Sequence[str]) -> str:
        """``TMN?``."""
        return items({name: self._state.travel(name)[0] for name in self._state.axes_of(args)})

    def upper(self, args: Sequence[str]) -> str:
        """``TMX?``."""
        return items({name: self._state.travel(name)[1] for name in self._state.axes_of(args)})

    def units(self, args: Sequence[str]) -> str:
        """``PUN?``."""
        return items(dict.fromkeys(self._state.axes_of(args), "urad"))

    def moving_mask(self) -> int:
        """``#5``: a bit for each axis that moves."""
        state = self._state
        mask = 0
        for bit, name in enumerate(state.axes):
            is_off_target = abs(state.position(name) - state.target(name)) > float(
                state.parameters[name, 0x07000900]
            )
            mask |= (state.is_zeroing(name) or state.is_wave_driven(name) or is_off_target) << bit
        return mask


def _require_unique(pairs: Sequence[Sequence[str]]) -> list[Sequence[str]]:
    """The groups, unless an axis comes twice."""
    names = [pair[0] for pair in pairs]
    if len(set(names)) < len(names):
        raise GcsError(22)
    return list(pairs)
