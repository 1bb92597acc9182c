"""What all parts of the emulated controller share: axes, servos, parameters, errors, complaints."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from escape_sim.emulators.e727.gcs import GcsError
from escape_sim.emulators.e727.recorder import POINTS, TABLES, DataRecorder
from escape_sim.emulators.e727.stage import SERVO_S, Axis, Hold, Ramp, Stage, Wave

#: Microradians per volt, and the volts that the amplifier gives.
PER_VOLT, VOLTS = 20.0, (-30.0, 130.0)
#: How far the sensors are off before auto-zero, in microradians.
UNZEROED_OFFSET = 30.0


@dataclass(frozen=True)
class ControllerSettings:
    """Which controller and stage to be.

    Parameters
    ----------
    serial
        Serial number of the controller.
    travel
        Range of both axes in microradians.
    loops
        Frequency (Hz) and damping of each axis' closed loop.
    auto_zero_s
        Duration of auto-zero; about a minute on the real one.
    zeroed
        Auto-zero was done before (it survives until power is cut).
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
    """The controller's state.

    Parameters
    ----------
    make
        Which one it is.
    clock
        Seconds, monotonic.
    """

    settings: ControllerSettings
    clock: Callable[[], float]
    error: int = 0
    level: int = 0
    complaints: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.power_up(zeroed=self.settings.zeroed)

    def power_up(self, *, zeroed: bool) -> None:
        """State after a reset; what auto-zero found survives one, not a power cut."""
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
        """Write down what a careful driver would not do."""
        self.complaints.append(text)

    def axis(self, name: str) -> Axis:
        """A moving axis.

        Raises
        ------
        Refusal
            15 for an unknown axis, and for the third channel, which carries no stage.
        """
        if name not in self.stage.axes:
            raise GcsError(15)
        return self.stage.axes[name]

    def axes_of(self, args: Sequence[str]) -> list[str]:
        """The axes that a query names; all when it names none."""
        for name in args:
            self.axis(name)
        return list(args) or list(self.axes)

    def travel(self, name: str) -> tuple[float, float]:
        """Range of an axis, as its parameters have it."""
        low, high = (self.parameters[name, number] for number in (0x07000000, 0x07000001))
        return float(low), float(high)

    def is_wave_driven(self, name: str) -> bool:
        """True while a wave generator drives the axis."""
        trajectory = self.stage.axes[name].trajectory
        return (
            isinstance(trajectory, Wave)
            and not trajectory.is_finished(self.stage.now)
            and not self.is_zeroing(name)
        )

    def is_zeroing(self, name: str) -> bool:
        """True while auto-zero runs; ends it when its time has come."""
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
        """Refuse while auto-zero or a wave generator moves the axis."""
        if self.is_zeroing(name):
            raise GcsError(61)
        if self.is_wave_driven(name):
            raise GcsError(73)

    def position(self, name: str) -> float:
        """What the axis' sensor says now."""
        self.stage.advance()
        # A closed loop makes right what its sensor says, however far that is off.
        is_accurate = self.axes[name].zeroed or self.axes[name].servo
        offset = 0.0 if is_accurate else UNZEROED_OFFSET
        return self.stage.axes[name].position + offset

    def target(self, name: str) -> float:
        """Where the axis is told to be now; of a move its end."""
        trajectory = self.stage.axes[name].trajectory
        if isinstance(trajectory, Ramp):
            return trajectory.end
        return float(self.stage.axes[name].trajectory.at(np.array([self.stage.now]))[0])

    def describe(self) -> str:
        """In what condition the stage is: turning, servo on, driven or at rest."""
        if any(self.is_wave_driven(name) for name in self.axes):
            return "turning"
        if any(axis.servo for axis in self.axes.values()):
            return "servo on"
        return "driven" if any(axis.volts for axis in self.axes.values()) else "at rest"
