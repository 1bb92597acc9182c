"""The thin shell of an adaptive secondary as it behaves: states, gap, currents, sensors, faults."""

from __future__ import annotations

import time
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.adaptive_secondary import ShellState
from escape_sim.mirror_dynamics import MirrorDynamics

#: Gap of the floating shell (paper: about 50 um) and of one that lies on its reference body, metres.
GAP_M, RESTED_GAP_M = 50e-6, 2e-6
#: Noise of a capacitive position sensor in metres.
SENSOR_NOISE_M = 3e-9
#: Time in seconds that each step of the ladder takes.
STEP_S = {ShellState.OFF: 0.5, ShellState.RESTED: 1.0, ShellState.SET: 2.0, ShellState.RUNNING: 0.1}
#: Coil current in amperes that holds the shell, and what full stroke against the stiff shell adds.
HOLD_A, STROKE_A = 0.05, 0.5
#: Temperature in degrees Celsius of coils without current, and its rise per ampere.
AMBIENT_C, RISE_C_PER_A = 15.0, 10.0


class Plant(Protocol):
    """What moves: actuators that follow shapes ``(n_act,)``, fractions of full stroke, in their time."""

    @property
    def now_s(self) -> float:
        """Monotonic seconds."""

    def drive(self, shape: NDArray[np.float64]) -> None:
        """A command on its usual way, with whatever latency that has."""

    def place(self, shape: NDArray[np.float64]) -> None:
        """A shape that is taken at once, without a command."""

    def positions(self) -> NDArray[np.float64]:
        """Where the actuators are now."""


class WallPlant:
    """Actuators that move in real time.

    Parameters
    ----------
    n_act
        Number of actuators.
    settling_s
        Time to settle within 5 % of a step, in seconds.
    """

    def __init__(self, n_act: int, settling_s: float) -> None:
        self._start = time.monotonic()
        self._dynamics = MirrorDynamics(n_act, settling_s, 0.0, 1.0)

    @property
    def now_s(self) -> float:
        """Seconds since it was made."""
        return time.monotonic() - self._start

    def drive(self, shape: NDArray[np.float64]) -> None:
        """Take a command now."""
        self._dynamics.command(self.now_s, shape)

    place = drive

    def positions(self) -> NDArray[np.float64]:
        """Where the actuators are now."""
        now = self.now_s
        return self._dynamics.mean(now, now)


class Shell:
    """State, fault and sensors of a shell over actuators that move.

    Parameters
    ----------
    plant
        The actuators.
    n_act
        How many.
    stroke_m
        Metres of surface for a command of 1.
    noise
        Random generator of the position sensors.
    """

    def __init__(self, plant: Plant, n_act: int, stroke_m: float, noise: np.random.Generator) -> None:
        self._plant, self.n_act, self.stroke_m, self._noise = plant, n_act, stroke_m, noise
        self.state, self.fault = ShellState.OFF, ""
        #: Actuators whose sensor delivers nothing, and those whose coil carries too much: (number, A).
        self.blind: set[int] = set()
        self.excess_a: dict[int, float] = {}

    @property
    def floats(self) -> bool:
        """True while the shell does not touch its reference body."""
        return self.state in (ShellState.SET, ShellState.RUNNING)

    def arrive(self, state: ShellState, flat: NDArray[np.float64]) -> None:
        """End a step of the ladder: afloat the shell is flat, at rest it has its body's shape."""
        self.state = state
        self._plant.place(flat if self.floats else np.zeros(self.n_act))

    def drive(self, shape: NDArray[np.float64]) -> None:
        """A command ``(n_act,)``, fractions of full stroke, on its usual way."""
        self._plant.drive(shape)

    def trip(self, reason: str) -> None:
        """Coils off: the shell falls back on its reference body, latched."""
        self.state, self.fault = ShellState.FAULT, reason
        self._plant.place(np.zeros(self.n_act))

    def recover(self) -> None:
        """End a fault; the shell lies at rest."""
        self.state, self.fault = ShellState.RESTED, ""

    def measured(self) -> NDArray[np.float64]:
        """Noisy positions ``(n_act,)``, fractions of full stroke; NaN where a sensor is blind."""
        found = self._plant.positions()
        found = found + self._noise.standard_normal(found.size) * (SENSOR_NOISE_M / self.stroke_m)
        if self.blind:
            found[sorted(self.blind)] = np.nan
        return found

    def gap_m(self) -> float:
        """Mean gap in metres."""
        if not self.floats:
            return RESTED_GAP_M
        return GAP_M + float(self._plant.positions().mean()) * self.stroke_m

    def currents_a(self) -> NDArray[np.float64]:
        """Coil currents ``(n_act,)`` in amperes."""
        if not self.floats:
            return np.zeros(self.n_act)
        currents = HOLD_A + STROKE_A * np.abs(self._plant.positions())
        for actuator, ampere in self.excess_a.items():
            currents[actuator] = ampere
        return currents
