"""A tip-tilt stage behind a digital servo: second order, integrated on the servo's clock when looked at."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.signal import cont2discrete, lfilter, lfilter_zi

#: Period of the servo in seconds (parameter 0x0E000200).
SERVO_S = 50e-6
#: Steps after which nothing is left of a transient (0.4 s).
TRANSIENT_STEPS = 8192


class Trajectory(Protocol):
    """Where an axis is told to be, step by step."""

    def at(self, steps: NDArray[np.int64]) -> NDArray[np.float64]:
        """Targets at servo steps."""
        ...


@dataclass(frozen=True)
class Hold:
    """One place."""

    place: float

    def at(self, steps: NDArray[np.int64]) -> NDArray[np.float64]:
        """The place, again and again."""
        return np.full(len(steps), self.place)


@dataclass(frozen=True)
class Ramp:
    """From one place to another at a constant velocity.

    Parameters
    ----------
    begin, end
        Places.
    start
        Servo step of the beginning.
    per_step
        Way in a servo period.
    """

    begin: float
    end: float
    start: int
    unit_command_factor: float

    def at(self, steps: NDArray[np.int64]) -> NDArray[np.float64]:
        """Targets; the end is held."""
        way = np.clip((steps - self.start) * self.unit_command_factor, 0.0, abs(self.end - self.begin))
        return np.asarray(self.begin + np.copysign(way, self.end - self.begin))


@dataclass(frozen=True, eq=False)
class Wave:
    """A wave table played back.

    Parameters
    ----------
    table
        Targets.
    start
        Servo step of its first point.
    rate
        Servo steps for each point.
    cycles
        How often; 0: endless.
    interpolate
        Straight lines between points, or steps.
    """

    table: NDArray[np.float64]
    start: int
    rate: int = 1
    cycles: int = 0
    interpolate: bool = False

    def is_finished(self, step: int) -> bool:
        """True when all cycles have been played by this step."""
        return self.cycles > 0 and step - self.start >= self.cycles * self.rate * len(self.table)

    def at(self, steps: NDArray[np.int64]) -> NDArray[np.float64]:
        """Targets; the last point is held at the end."""
        n = len(self.table)
        along = np.maximum(steps - self.start, 0)
        if self.cycles:
            along = np.minimum(along, self.cycles * n * self.rate - 1)
        point, part = np.divmod(along, self.rate)
        here: NDArray[np.float64] = self.table[point % n]
        if not self.interpolate or self.rate == 1:
            return here
        there = self.table[(point + 1) % n]
        return np.asarray(here + (there - here) * (part / self.rate))


@cache
def _closed_loop_filter(
    frequency_hz: float, damping: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Filter (numerator, denominator) on the servo's clock, and its state at a rest of 1."""
    w = 2 * np.pi * frequency_hz
    top, bottom, _ = cont2discrete(([w * w], [1.0, 2 * damping * w, w * w]), SERVO_S)
    return top.ravel(), bottom, lfilter_zi(top.ravel(), bottom)


@dataclass
class Axis:
    """One axis: a source of targets and a closed loop of second order that follows it late.

    Parameters
    ----------
    frequency_hz, damping
        Of the closed loop with the mirror's load.
    gain
        True position over measured position.
    """

    frequency_hz: float
    damping: float
    gain: float = 1.0
    trajectory: Trajectory = field(default_factory=lambda: Hold(0.0))

    def __post_init__(self) -> None:
        top, bottom, self._unit_state = _closed_loop_filter(self.frequency_hz, self.damping)
        self._filter = (top, bottom)
        self._state = self._unit_state * 0.0
        self._step = 0
        self.position = 0.0

    def advance(self, to: int) -> NDArray[np.float64]:
        """Move on to servo step ``to``; returns measured positions of the last steps before it."""
        first = max(self._step, to - TRANSIENT_STEPS)
        if to <= first:
            return np.empty(0)
        targets = self.trajectory.at(np.arange(first, to))
        if first > self._step:
            self._state = self._unit_state * targets[0]
        track, self._state = lfilter(*self._filter, targets, zi=self._state)
        self._step, self.position = to, float(track[-1])
        return np.asarray(track, np.float64)

    def steady(self, first: int, count: int) -> NDArray[np.float64]:
        """Measured positions over ``count`` steps from ``first`` on, of the present source for ever."""
        targets = self.trajectory.at(np.arange(first - TRANSIENT_STEPS, first + count))
        track, _ = lfilter(*self._filter, targets, zi=self._unit_state * targets[0])
        return np.asarray(track[TRANSIENT_STEPS:], np.float64)

    def set_position(self, place: float) -> None:
        """Be at a place, at rest."""
        self.trajectory = Hold(place)
        self._state, self.position = self._unit_state * place, place


class Stage:
    """The axes, and the servo's clock.

    Parameters
    ----------
    axes
        By name.
    clock
        Seconds, monotonic.
    """

    def __init__(self, axes: dict[str, Axis], clock: Callable[[], float]) -> None:
        self.axes, self._clock, self._start_s = axes, clock, clock()
        self._listeners: list[Callable[[int, dict[str, NDArray[np.float64]]], None]] = []
        self._step = 0

    @property
    def now(self) -> int:
        """Servo steps since power-on."""
        return int((self._clock() - self._start_s) / SERVO_S)

    def add_listener(self, listener: Callable[[int, dict[str, NDArray[np.float64]]], None]) -> None:
        """Call ``listener(first_step, positions)`` with every stretch of time that is integrated."""
        self._listeners.append(listener)

    def advance(self) -> int:
        """Integrate up to now; returns the present step."""
        end = self.now
        while self._step < end:
            # Stretches no longer than the memory, while somebody records; else one leap.
            until = min(end, self._step + TRANSIENT_STEPS) if self._listeners else end
            tracks = {name: axis.advance(until) for name, axis in self.axes.items()}
            first = until - len(next(iter(tracks.values())))
            for listener in list(self._listeners):
                listener(first, tracks)
            self._step = until
        return end

    def remove_listener(self, listener: Callable[[int, dict[str, NDArray[np.float64]]], None]) -> None:
        """Call it no more."""
        self._listeners.remove(listener)
