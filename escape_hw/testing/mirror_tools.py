"""Tools for checks on mirrors: gentle commands, a spy on the transfer, the rules spelt out again."""

from __future__ import annotations

import unittest
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.mirror import DeformableMirror
from escape_hw.safety.limits import nearest_pairs, neighbour_pairs
from escape_hw.testing.checks import replaced

#: Largest breach that counts as rounding, fraction of full stroke.
ROUNDING = 1e-9


def gentle(dm: DeformableMirror, amplitude: float = 0.01) -> NDArray[np.float64]:
    """Give the flat shape with one enabled actuator poked: legal from flat under any limits."""
    lim, flat = dm.limits, dm.flat
    enabled = np.setdiff1d(np.arange(flat.size), lim.disabled)
    if not enabled.size:
        raise unittest.SkipTest(f"{dm.name}: every actuator is disabled")
    bounds = (lim.max_stroke, lim.max_slew, lim.max_neighbour, lim.max_mean)
    size = min(amplitude, *(0.5 * bound for bound in bounds if bound is not None))
    chosen = enabled[np.abs(flat[enabled]).argmin()]
    flat[chosen] += -size if flat[chosen] > 0 else size
    return flat


@contextmanager
def spied(dm: DeformableMirror) -> Iterator[list[NDArray[np.float64]]]:
    """Record every command that the device took, in order."""
    reached: list[NDArray[np.float64]] = []
    transfer = dm._send  # noqa: SLF001 - what reaches the driver's transfer is what is checked

    def recording(command: NDArray[np.float64]) -> NDArray[np.float64] | None:
        assert command.dtype == np.float64, f"the driver got {command.dtype}, not float64"
        assert command.flags.c_contiguous, "the driver got a command that is not contiguous"
        assert command.shape == (dm.info.n_act,), f"the driver got shape {command.shape}"
        kept = transfer(command)
        if kept is None:
            reached.append(command.copy())
        return kept

    with replaced(dm, "_send", recording):
        yield reached


def breaches(dm: DeformableMirror, before: NDArray[np.float64], after: NDArray[np.float64]) -> list[str]:
    """Every limit that going from one shape to the next breaks (written anew, not asked of the guard)."""
    lim, found = dm.limits, []
    if not np.isfinite(after).all():
        found.append("a value is not finite")
    if np.abs(after).max() > lim.max_stroke:
        found.append(f"stroke {np.abs(after).max():.6g} > {lim.max_stroke}")
    if any(after[i] != 0 for i in lim.disabled):
        found.append(f"a disabled actuator of {lim.disabled} moved")
    if lim.max_slew is not None and np.abs(after - before).max() > lim.max_slew + ROUNDING:
        found.append(f"slew {np.abs(after - before).max():.6g} > {lim.max_slew}")
    enabled = np.setdiff1d(np.arange(after.size), lim.disabled)
    if lim.max_mean is not None and enabled.size and abs(after[enabled].mean()) > lim.max_mean + ROUNDING:
        found.append(f"mean {after[enabled].mean():.6g} > {lim.max_mean}")
    if lim.max_neighbour is not None:
        layout = dm.info.layout
        pairs = nearest_pairs(dm.info.positions_m) if layout is None else neighbour_pairs(layout)
        steps = [abs(after[a] - after[b]) for a, b in pairs]
        if max(steps, default=0.0) > lim.max_neighbour + ROUNDING:
            found.append(f"neighbours differ by {max(steps):.6g} > {lim.max_neighbour}")
    return found
