"""Tip-tilt stage behind a digital servo: second-order response, integrated on the servo clock when read."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.signal import cont2discrete, lfilter, lfilter_zi

#: Period of the servo in seconds (parameter 0x0E000200).
SERVO_S = 50e-6
#: Servo steps after which a transient has decayed (0.4 s).
TRANSIENT_STEPS = 8192


@dataclass(frozen=True)
class Hold:
    """A constant target."""

    target: float

    def at(self, steps: NDArray[np.int64]) -> NDArray[np.float64]:
        """Targets at servo steps ``(n,)`` in microradians."""
        return np.full(len(steps), self.target)


@dataclass(frozen=True)
class Ramp:
    """Move from ``begin`` to ``end`` from servo step ``start`` on, by ``step_size`` per servo step."""

    begin: float
    end: float
    start: int
    step_size: float

    def at(self, steps: NDArray[np.int64]) -> NDArray[np.float64]:
        """Targets at servo steps ``(n,)`` in microradians; the end is held."""
        distance = np.clip((steps - self.start) * self.step_size, 0.0, abs(self.end - self.begin))
        return np.asarray(self.begin + np.copysign(distance, self.end - self.begin))


@dataclass(frozen=True, eq=False)
class Wave:
    """Playback of a wave table from servo step ``start`` on, with ``rate`` servo steps per point.

    ``cycles`` 0 is endless; ``interpolate`` connects the points linearly.
    """

    table: NDArray[np.float64]
    start: int
    rate: int = 1
    cycles: int = 0
    interpolate: bool = False

    def is_finished(self, step: int) -> bool:
        """Whether all cycles have been played by this step."""
        return self.cycles > 0 and step - self.start >= self.cycles * self.rate * len(self.table)

    def at(self, steps: NDArray[np.int64]) -> NDArray[np.float64]:
        """Targets at servo steps ``(n,)`` in microradians; the last point is held at the end."""
        n = len(self.table)
        along = np.maximum(steps - self.start, 0)
        if self.cycles:
            along = np.minimum(along, self.cycles * n * self.rate - 1)
        point, part = np.divmod(along, self.rate)
        targets: NDArray[np.float64] = self.table[point % n]
        if not self.interpolate or self.rate == 1:
            return targets
        following = self.table[(point + 1) % n]
        return np.asarray(targets + (following - targets) * (part / self.rate))


#: Targets of an axis as a function of the servo step.
Trajectory = Hold | Ramp | Wave


@cache
def _closed_loop_filter(
    frequency_hz: float, damping: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Numerator and denominator of the filter on the servo clock, and its state for a constant input of 1."""
    w = 2 * np.pi * frequency_hz
    numerator, denominator, _ = cont2discrete(([w * w], [1.0, 2 * damping * w, w * w]), SERVO_S)
    return numerator.ravel(), denominator, lfilter_zi(numerator.ravel(), denominator)


@dataclass
class Axis:
    """One axis: a trajectory, and a closed loop of second order that follows it."""

    frequency_hz: float
    damping: float
    trajectory: Trajectory = field(default_factory=lambda: Hold(0.0))

    def __post_init__(self) -> None:
        *self._filter, self._unit_state = _closed_loop_filter(self.frequency_hz, self.damping)
        self._state = self._unit_state * 0.0
        self._step = 0
        self.position = 0.0

    def advance(self, to: int) -> NDArray[np.float64]:
        """Advance to servo step ``to``; returns positions ``(n,)`` of the last steps before it [µrad]."""
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
        """Measured positions ``(count,)`` in microradians from step ``first`` on, without a transient."""
        targets = self.trajectory.at(np.arange(first - TRANSIENT_STEPS, first + count))
        track, _ = lfilter(*self._filter, targets, zi=self._unit_state * targets[0])
        return np.asarray(track[TRANSIENT_STEPS:], np.float64)


class Stage:
    """The axes by name, and the servo clock, derived from a monotonic ``clock`` in seconds."""

    def __init__(self, axes: dict[str, Axis], clock: Callable[[], float]) -> None:
        self.axes, self._clock, self._start_s = axes, clock, clock()
        self._listeners: list[Callable[[int, dict[str, NDArray[np.float64]]], None]] = []
        self._step = 0

    @property
    def now(self) -> int:
        """Servo steps since power-on."""
        return int((self._clock() - self._start_s) / SERVO_S)

    def add_listener(self, listener: Callable[[int, dict[str, NDArray[np.float64]]], None]) -> None:
        """Call ``listener(first_step, positions)`` for every interval that is integrated."""
        self._listeners.append(listener)

    def advance(self) -> int:
        """Integrate up to now; returns the present servo step."""
        end = self.now
        while self._step < end:
            # While a listener records, intervals must not exceed the steps that are returned.
            until = min(end, self._step + TRANSIENT_STEPS) if self._listeners else end
            tracks = {name: axis.advance(until) for name, axis in self.axes.items()}
            first = until - len(next(iter(tracks.values())))
            for listener in list(self._listeners):
                listener(first, tracks)
            self._step = until
        return end

    def remove_listener(self, listener: Callable[[int, dict[str, NDArray[np.float64]]], None]) -> None:
        """Remove a listener."""
        self._listeners.remove(listener)
