"""State of the emulated controller: axes, servos, parameters, error number, protocol violations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from escape_sim.emulators.e727.gcs import GcsCommandError, format_items
from escape_sim.emulators.e727.recorder import POINTS, TABLES, DataRecorder
from escape_sim.emulators.e727.stage import SERVO_S, Axis, Hold, Ramp, Stage, Wave

#: Microradians per volt, and range of the amplifier in volts.
PER_VOLT, VOLTS = 20.0, (-30.0, 130.0)
#: Offset of the sensors before auto-zero in microradians.
UNZEROED_OFFSET = 30.0


@dataclass(frozen=True)
class ControllerSettings:
    """Properties of controller and stage.

    Parameters
    ----------
    serial
        Serial number of the controller.
    travel
        Range of both axes in microradians.
    loops
        Frequency (Hz) and damping of each axis' closed loop.
    auto_zero_s
        Duration of auto-zero in seconds; about a minute on the real controller.
    zeroed
        Whether auto-zero was done before; it is kept until power is cut.
    """

    serial: str = "0123456789"
    travel: float = 2000.0
    loops: tuple[tuple[float, float], ...] = ((900.0, 0.75), (750.0, 0.8))
    auto_zero_s: float = 1.0
    zeroed: bool = False


@dataclass
class AxisState:
    """Servo, volts and auto-zero of one axis."""

    servo: bool = False
    volts: float = 0.0
    zeroed: bool = False
    zero_failed: bool = False
    zero_end_step: int | None = None
    velocity: float = 1e6


@dataclass
class ControllerState:
    """State of a controller, on a monotonic ``clock`` in seconds."""

    settings: ControllerSettings
    clock: Callable[[], float]
    error: int = 0
    level: int = 0
    violations: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.power_up(zeroed=self.settings.zeroed)

    def power_up(self, *, zeroed: bool) -> None:
        """State after a reset. The result of auto-zero survives a reset but not a power cut."""
        loops = zip(("1", "2"), self.settings.loops, strict=True)
        self.stage = Stage({name: Axis(*loop) for name, loop in loops}, self.clock)
        self.recorder = DataRecorder(self.stage)
        self.axes = {name: AxisState(zeroed=zeroed) for name in self.stage.axes}
        self.error, self.level = 0, 0
        self.parameters: dict[tuple[str, int], float | int] = {}
        for name in self.axes:
            self.parameters |= {
                (name, 0x07000000): 0.0, (name, 0x07000001): self.settings.travel, (name, 0x07000900): 2.0,
                (name, 0x07000901): 0.01, (name, 0x07000A00): 0.0, (name, 0x07000A01): 0,
            }  # fmt: skip
        system = {0x0E000200: SERVO_S, 0x16000200: POINTS, 0x16000300: TABLES}
        self.parameters |= {("1", number): value for number, value in system.items()}

    def report_violation(self, text: str) -> None:
        """Record a violation of the protocol by a client."""
        self.violations.append(text)

    def axis(self, name: str) -> Axis:
        """A moving axis; raises error 15 for other names and for the third channel, which has no stage."""
        if name not in self.stage.axes:
            raise GcsCommandError(15)
        return self.stage.axes[name]

    def axes_of(self, args: Sequence[str]) -> list[str]:
        """The axes named by a query, by default all."""
        for name in args:
            self.axis(name)
        return list(args) or list(self.axes)

    def per_axis(self, value: Callable[[str], float | int | str]) -> Callable[[Sequence[str]], str]:
        """Handler of a query that returns ``value(axis)`` for each axis."""
        return lambda args: format_items({name: value(name) for name in self.axes_of(args)})

    def travel(self, name: str) -> tuple[float, float]:
        """Range of an axis in microradians, from its parameters."""
        low, high = (self.parameters[name, number] for number in (0x07000000, 0x07000001))
        return float(low), float(high)

    def is_wave_driven(self, name: str) -> bool:
        """Whether a wave generator drives the axis."""
        trajectory = self.stage.axes[name].trajectory
        return (
            isinstance(trajectory, Wave)
            and not trajectory.is_finished(self.stage.now)
            and not self.is_zeroing(name)
        )

    def is_zeroing(self, name: str) -> bool:
        """Whether auto-zero is running; completes it when its time is over."""
        axis = self.axes[name]
        if axis.zero_end_step is None:
            return False
        if self.stage.now < axis.zero_end_step:
            return True
        self.stage.advance()
        axis.zero_end_step, axis.zeroed = None, not axis.zero_failed
        self.stage.axes[name].trajectory = Hold(axis.volts * PER_VOLT)
        if axis.zero_failed:
            self.error = 98
        return False

    def require_idle(self, name: str) -> None:
        """Raise an error while auto-zero (61) or a wave generator (73) moves the axis."""
        if self.is_zeroing(name):
            raise GcsCommandError(61)
        if self.is_wave_driven(name):
            raise GcsCommandError(73)

    def position(self, name: str) -> float:
        """Present reading of the axis' sensor in microradians."""
        self.stage.advance()
        # A closed loop corrects to the sensor's reading, whatever its offset.
        is_accurate = self.axes[name].zeroed or self.axes[name].servo
        offset = 0.0 if is_accurate else UNZEROED_OFFSET
        return self.stage.axes[name].position + offset

    def target(self, name: str) -> float:
        """Present target of an axis in microradians; for a move its end."""
        trajectory = self.stage.axes[name].trajectory
        if isinstance(trajectory, Ramp):
            return trajectory.end
        return float(self.stage.axes[name].trajectory.at(np.array([self.stage.now]))[0])

    def describe(self) -> str:
        """Condition of the stage: "turning", "servo on", "driven" or "at rest"."""
        if any(self.is_wave_driven(name) for name in self.axes):
            return "turning"
        if any(axis.servo for axis in self.axes.values()):
            return "servo on"
        return "driven" if any(axis.volts for axis in self.axes.values()) else "at rest"
