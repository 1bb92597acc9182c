"""Temporal response of the simulated actuators: command latency, settling, creep, saturation."""

from __future__ import annotations

import copy
import threading
from collections import deque

import numpy as np
from numpy.typing import NDArray

#: A critically damped step is within 5 % of its end after this many time constants.
_SETTLING_TIME_CONSTANTS = 4.744


class MirrorDynamics:
    """Critically damped actuators with slow creep, driven by time-stamped commands.

    Thread-safe: commands may come from another thread than the one that reads positions.

    Parameters
    ----------
    n_act
        Number of actuators.
    settling_s
        Time to settle within 5 % of a step, in seconds.
    creep_fraction, creep_time_s
        Share of a step that creep adds to it, and time constant of the creep in seconds.
    """

    def __init__(self, n_act: int, settling_s: float, creep_fraction: float, creep_time_s: float) -> None:
        self._rate = _SETTLING_TIME_CONSTANTS / max(settling_s, 1e-7)
        self._creep_share, self._creep_time = creep_fraction, creep_time_s
        self._time = 0.0
        self._target = np.zeros(n_act)
        self._position = np.zeros(n_act)
        self._speed = np.zeros(n_act)
        self._creep = np.zeros(n_act)
        self._pending: deque[tuple[float, NDArray[np.float64]]] = deque()
        self._lock = threading.RLock()

    def command(self, time_s: float, target: NDArray[np.float64]) -> None:
        """Queue a command that reaches the actuators at ``time_s``; clipped to full stroke."""
        with self._lock:
            self._pending.append((time_s, np.clip(target, -1.0, 1.0)))

    def mean(self, start_s: float, end_s: float) -> NDArray[np.float64]:
        """Mean displacement ``(n_act,)`` over an interval, in fractions of full stroke.

        Advances the time. The part of the interval before the present time is ignored.
        """
        with self._lock:
            start = max(start_s, self._time)
            self._advance(start)
            if end_s <= start:
                return self._position + self._creep_share * self._creep
            total = self._advance(end_s)
            return total / (end_s - start) + self._creep_share * self._creep

    def at(self, time_s: float) -> NDArray[np.float64]:
        """Displacement ``(n_act,)`` at a future time, fractions of full stroke; does not advance the time."""
        with self._lock:
            # Arrays are replaced and never modified, so the copy may share them.
            future = copy.copy(self)
            future._pending = self._pending.copy()  # noqa: SLF001
            return future.mean(time_s, time_s)

    def _advance(self, until_s: float) -> NDArray[np.float64]:
        """Advance to ``until_s`` and return the integral of the position."""
        total = np.zeros_like(self._position)
        while self._pending and self._pending[0][0] <= until_s:
            at, target = self._pending.popleft()
            total += self._integrate_motion(max(at, self._time))
            self._target = target
        return total + self._integrate_motion(until_s)

    def _integrate_motion(self, until_s: float) -> NDArray[np.float64]:
        duration_s = until_s - self._time
        if duration_s <= 0:
            return np.zeros_like(self._position)
        w = self._rate
        decay = np.exp(-w * duration_s)
        lag = self._position - self._target
        slope = self._speed + w * lag
        total = (
            self._target * duration_s
            + lag * (1 - decay) / w
            + slope * (1 - decay * (1 + w * duration_s)) / w**2
        )
        self._position = self._target + (lag + slope * duration_s) * decay
        self._speed = (self._speed - w * slope * duration_s) * decay
        self._creep = self._creep + (self._target - self._creep) * -np.expm1(-duration_s / self._creep_time)
        self._time = until_s
        return np.asarray(total)
