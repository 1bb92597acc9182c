"""Notices that a loop does more harm than good."""

from __future__ import annotations

import math
from array import array

#: Frames over which the residual is taken as it is now ...
_FAST = 50
#: ... and over which as it usually is.
_SLOW = 2000
#: Growth of the residual's rms that no weather explains.
_GROWTH = 4.0


class DivergenceWatch:
    """Opens a loop whose residual leaves what it was, before the mirror reaches its limits.

    The residual counts as diverging when its rms over the last frames is several times the usual one
    and above what the loop found when it closed: so a loop that still converges, or one that suffers a
    gust, stays closed.
    """

    def __init__(self) -> None:
        self._fast = self._slow = self._first = math.nan
        self._seen = 0

    def __call__(self, residual: array[float]) -> bool:
        """Take the residuals that came since the last call, in nm; whether they diverge."""
        for value in residual:
            square = value * value
            if not self._seen:
                self._fast = self._slow = self._first = square
            self._seen += 1
            self._first = max(self._first, square) if self._seen <= _FAST else self._first
            self._fast += (square - self._fast) / min(self._seen, _FAST)
            self._slow += (square - self._slow) / min(self._seen, _SLOW)
        if self._seen < 2 * _FAST:
            return not math.isfinite(self._fast)
        usual = max(_GROWTH**2 * self._slow, self._first)
        # A number that is none compares as false.
        return not self._fast <= usual

    @property
    def growth(self) -> float:
        """Rms now over the usual rms."""
        return math.sqrt(self._fast / self._slow) if self._slow > 0 else math.nan
