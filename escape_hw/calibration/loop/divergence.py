"""Notices that a loop does more harm than good."""

from __future__ import annotations

import math
from array import array

#: Frames over which the residual is taken as it is now ...
_FAST_FRAMES = 50
#: ... and over which as it usually is.
_SLOW_FRAMES = 2000
#: Growth of the residual's rms that no weather explains.
_MAX_GROWTH = 4.0


class DivergenceMonitor:
    """Opens a loop whose residual leaves what it was, before the mirror reaches its limits.

    The residual counts as diverging when its rms over the last frames is several times the usual one
    and above what the loop found when it closed: so a loop that still converges, or one that suffers a
    gust, stays closed.
    """

    def __init__(self) -> None:
        self._fast_mean = self._slow_mean = self._initial_max = math.nan
        self._n_residuals = 0

    def __call__(self, residual: array[float]) -> bool:
        """Take the residuals that came since the last call, in nm; whether they diverge."""
        for value in residual:
            square = value * value
            if not self._n_residuals:
                self._fast_mean = self._slow_mean = self._initial_max = square
            self._n_residuals += 1
            self._initial_max = (
                max(self._initial_max, square) if self._n_residuals <= _FAST_FRAMES else self._initial_max
            )
            self._fast_mean += (square - self._fast_mean) / min(self._n_residuals, _FAST_FRAMES)
            self._slow_mean += (square - self._slow_mean) / min(self._n_residuals, _SLOW_FRAMES)
        if self._n_residuals < 2 * _FAST_FRAMES:
            return not math.isfinite(self._fast_mean)
        limit = max(_MAX_GROWTH**2 * self._slow_mean, self._initial_max)
        # A number that is none compares as false.
        return not self._fast_mean <= limit

    @property
    def growth(self) -> float:
        """Rms now over the usual rms."""
        return math.sqrt(self._fast_mean / self._slow_mean) if self._slow_mean > 0 else math.nan
