"""Seeing that changes with time."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from escape_hw.config.twin_drift import TwinSeeing


class Seeing:
    """Fried parameter and strength of the turbulence, relative to the start: hidden truth.

    Parameters
    ----------
    told
        Rate, sinusoid and limits.
    """

    def __init__(self, told: TwinSeeing) -> None:
        self._told = told

    def r0(self, time_s: float) -> float:
        """Fried parameter at a time of the twin's clock, relative to the start."""
        t = self._told
        free = 1 + t.rate * time_s + t.swing * math.sin(2 * math.pi * time_s / t.period_s)
        return min(max(free, t.least), t.most)

    def strength(self, time_s: float) -> float:
        """Factor on the optical path: ``r0^(-5/6)``, for its variance goes with ``r0^(-5/3)``."""
        return float(self.r0(time_s) ** (-5 / 6))
