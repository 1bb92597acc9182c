"""A small mirror for the tests of the guard, and an independent implementation of its rules."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from escape_hw.safety.guard import CommandGuard
from escape_hw.safety.limits import MirrorLimits, neighbour_pairs

AXIS = np.arange(5) - 2
LAYOUT = AXIS[:, None] ** 2 + AXIS**2 <= 5
N = int(LAYOUT.sum())
PAIRS = neighbour_pairs(LAYOUT)
ROUNDING = 1e-10


def guard_with(limits: MirrorLimits) -> CommandGuard:
    return CommandGuard("dm", N, limits, PAIRS)


def static_breaches(lim: MirrorLimits, shape: NDArray[np.float64]) -> list[str]:
    """Rules that a shape breaks by itself, written out again from their definitions."""
    enabled = [i for i in range(N) if i not in lim.disabled]
    broken = []
    if not np.isfinite(shape).all():
        broken.append("finite")
    if max(abs(shape)) > lim.max_stroke:
        broken.append("stroke")
    if any(shape[i] != 0 for i in lim.disabled):
        broken.append("disabled")
    if lim.max_abs_sum is not None and np.abs(shape).sum() > lim.max_abs_sum + ROUNDING:
        broken.append("sum")
    if lim.max_mean is not None and enabled and abs(np.mean(shape[enabled])) > lim.max_mean + ROUNDING:
        broken.append("mean")
    if lim.max_neighbour is not None:
        worst = max(abs(shape[a] - shape[b]) for a, b in PAIRS)
        if worst > lim.max_neighbour + ROUNDING:
            broken.append("neighbour")
    return broken


def breaches(lim: MirrorLimits, before: NDArray[np.float64], after: NDArray[np.float64]) -> list[str]:
    broken = static_breaches(lim, after)
    if lim.max_slew is not None and max(abs(after - before)) > lim.max_slew + ROUNDING:
        broken.append("slew")
    return broken
