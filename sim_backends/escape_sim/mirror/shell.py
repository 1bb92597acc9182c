"""Thin shell of an adaptive secondary: states, gap, coil currents, position sensors, faults."""

from __future__ import annotations

import time
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.adaptive_secondary import ShellState
from escape_sim.mirror.dynamics import MirrorDynamics

#: Gap of the floating shell (paper: about 50 um) and of one that lies on its reference body, metres.
FLOATING_GAP_M, RESTED_GAP_M = 50e-6, 2e-6
#: Noise of a capacitive position sensor in metres.
SENSOR_NOISE_M = 3e-9
#: Duration in seconds of the transition into each state.
TRANSITION_S = {ShellState.OFF: 0.5, ShellState.RESTED: 1.0, ShellState.SET: 2.0, ShellState.RUNNING: 0.1}
#: Coil current in amperes that holds the shell, and what full stroke adds.
HOLDING_CURRENT_A, FULL_STROKE_CURRENT_A = 0.05, 0.5
#: Temperature in degrees Celsius of coils without current, and its rise per ampere.
AMBIENT_C, RISE_C_PER_A = 15.0, 10.0


class MovingActuators(Protocol):
    """Actuators that follow shapes ``(n_act,)``, fractions of full stroke, in time."""

    def drive(self, shape: NDArray[np.float64]) -> None:
        """Command a shape, with the latency of commands."""

    def set_positions(self, shape: NDArray[np.float64]) -> None:
        """Set a shape immediately."""

    def positions(self) -> NDArray[np.float64]:
        """Present positions."""


class RealTimeActuators:
    """Actuators that move in real time and settle within 5 % of a step in ``settling_s`` seconds."""

    def __init__(self, n_act: int, settling_s: float) -> None:
        self._start_s = time.monotonic()
        self._dynamics = MirrorDynamics(n_act, settling_s, 0.0, 1.0)

    def drive(self, shape: NDArray[np.float64]) -> None:
        """Command a shape now."""
        self._dynamics.command(time.monotonic() - self._start_s, shape)

    set_positions = drive

    def positions(self) -> NDArray[np.float64]:
        """Present positions."""
        now_s = time.monotonic() - self._start_s
        return self._dynamics.mean(now_s, now_s)


class Shell:
    """State, fault and sensors of a shell on moving actuators.

    ``stroke_m`` are the metres of surface for a command of 1; ``noise`` is that of the position sensors.
    """

    def __init__(
        self, actuators: MovingActuators, n_act: int, stroke_m: float, noise: np.random.Generator
    ) -> None:
        self._actuators, self.n_act, self.stroke_m, self._noise = actuators, n_act, stroke_m, noise
        self.state, self.fault = ShellState.OFF, ""
        #: Actuators whose position sensor fails.
        self.unreadable: set[int] = set()
        #: Coil current in amperes of actuators that draw too much.
        self.excess_a: dict[int, float] = {}

    @property
    def is_floating(self) -> bool:
        """True while the shell does not touch its reference body."""
        return self.state in (ShellState.SET, ShellState.RUNNING)

    def finish_transition(self, state: ShellState, flat: NDArray[np.float64]) -> None:
        """End a transition: a floating shell takes the shape ``flat``, a rested one lies on its body."""
        self.state = state
        self._actuators.set_positions(flat if self.is_floating else np.zeros(self.n_act))

    def drive(self, shape: NDArray[np.float64]) -> None:
        """Command a shape ``(n_act,)`` in fractions of full stroke."""
        self._actuators.drive(shape)

    def trip(self, reason: str) -> None:
        """Latch a fault: the coils are off and the shell lies on its reference body."""
        self.state, self.fault = ShellState.FAULT, reason
        self._actuators.set_positions(np.zeros(self.n_act))

    def recover(self) -> None:
        """End a fault; the shell is rested."""
        self.state, self.fault = ShellState.RESTED, ""

    def measure_positions(self) -> NDArray[np.float64]:
        """Noisy positions ``(n_act,)``, fractions of full stroke; NaN for unreadable sensors."""
        positions = self._actuators.positions()
        measured = positions + self._noise.standard_normal(positions.size) * (SENSOR_NOISE_M / self.stroke_m)
        measured[sorted(self.unreadable)] = np.nan
        return measured

    def gap_m(self) -> float:
        """Mean gap in metres."""
        if not self.is_floating:
            return RESTED_GAP_M
        return FLOATING_GAP_M + float(self._actuators.positions().mean()) * self.stroke_m

    def currents_a(self) -> NDArray[np.float64]:
        """Coil currents ``(n_act,)`` in amperes."""
        if not self.is_floating:
            return np.zeros(self.n_act)
        currents = HOLDING_CURRENT_A + FULL_STROKE_CURRENT_A * np.abs(self._actuators.positions())
        for actuator, ampere in self.excess_a.items():
            currents[actuator] = ampere
        return currents
