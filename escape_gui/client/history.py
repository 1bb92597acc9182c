"""Strehl ratio and residual of the last hours, recorded while a window is open. No widgets."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from escape_hw.remote.state import State

#: Number of states that are kept: 12 hours at five states a second, 14 MB when full.
HISTORY_SIZE = 12 * 3600 * 5
#: Interval between two states from which the curves have a gap, seconds.
_GAP_S = 2.0


class TimeSeriesBuffer:
    """Times and values of the last ``size`` entries."""

    def __init__(self, size: int) -> None:
        # Memory that nothing was written to is not taken from the system.
        self._times, self._values = np.empty(2 * size), np.empty(2 * size)
        self._size, self._end = size, 0

    def add(self, time: float, value: float) -> None:
        """Add an entry; times in seconds, increasing."""
        if self._end == self._times.size:
            for buffer in (self._times, self._values):
                buffer[: self._size] = buffer[self._size :]
            self._end = self._size
        self._times[self._end], self._values[self._end] = time, value
        self._end += 1

    def clear(self) -> None:
        self._end = 0

    @property
    def arrays(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Times and values ``(n,)``, oldest first; views that the next :meth:`add` may overwrite."""
        part = slice(max(self._end - self._size, 0), self._end)
        return self._times[part], self._values[part]


class LoopHistory:
    """Strehl ratio in % and residual in nm rms, from every state, whichever panels are visible.

    It survives the end of an engine and a reconnection; another system starts a new one.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self.strehl, self.residual = TimeSeriesBuffer(HISTORY_SIZE), TimeSeriesBuffer(HISTORY_SIZE)
        #: Whether the loop was ever closed.
        self.has_data = False
        self._key, self._last_s = ("", 0, 0), 0.0

    def update(self, state: State) -> None:
        """Record a state; the same state is recorded once, and an open loop as a gap."""
        key = (state.system, state.server_pid, state.serial)
        if key == self._key:
            return
        if state.system != self._key[0]:
            self.clear()
        self._key = key
        loop = state.loop
        self.has_data = self.has_data or loop.closed
        if not self.has_data:
            return
        now = self._clock()
        if now - self._last_s > _GAP_S:
            self._add(now, np.nan, np.nan)
        self._last_s = now
        strehl = np.nan if loop.strehl is None or not loop.closed else 100 * loop.strehl
        # Zero until the first measurement after closing.
        self._add(now, strehl, loop.residual_nm if loop.closed and loop.residual_nm > 0 else np.nan)

    def _add(self, now: float, strehl: float, residual: float) -> None:
        self.strehl.add(now, strehl)
        self.residual.add(now, residual)

    def clear(self) -> None:
        """Discard everything."""
        self.strehl.clear()
        self.residual.clear()
        self.has_data = False
