"""The best parameters of an arm, so that luck with the air does not choose them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.runtime.sweep.plan import EXPLORE, SHORTLIST
from escape_hw.runtime.sweep.space import Choices, Parameter, Range
from escape_hw.runtime.sweep.store import Record

#: Most neighbours whose mean stands for a loop, and the share of all loops that they are at most.
_NEIGHBOURS, _SHARE = 10, 0.05


def shortlist(
    records: Sequence[Record], space: Sequence[Parameter], arm: str, count: int
) -> list[dict[str, Any]]:
    """The parameters of the most promising loops of an arm's first stage, best first.

    A loop's promise is the mean merit of its nearest neighbours among the parameters, itself included:
    a single loop may owe its Strehl ratio to its air. Loops that diverged count with 0.

    Parameters
    ----------
    records
        Finished loops.
    space
        What was varied.
    arm
        Label of the arm.
    count
        How many; fewer where fewer loops stayed closed.
    """
    mine = [r for r in records if r.slot.stage == EXPLORE and r.slot.arm == arm]
    closed = [number for number, record in enumerate(mine) if record.merit > 0]
    if not closed:
        return []
    places = np.stack([_place(record.values, space) for record in mine])
    merits = np.array([record.merit for record in mine])
    near = max(1, min(_NEIGHBOURS, round(_SHARE * len(mine))))
    promise = {n: _mean_of_nearest(places, merits, n, near) for n in closed}
    order = sorted(closed, key=lambda n: promise[n], reverse=True)
    return [mine[n].values for n in order[:count]]


def _mean_of_nearest(
    places: NDArray[np.float64], merits: NDArray[np.float64], number: int, near: int
) -> float:
    distance = np.square(places - places[number]).sum(axis=1)
    return float(merits[np.argsort(distance, kind="stable")[:near]].mean())


def _place(values: dict[str, Any], space: Sequence[Parameter]) -> NDArray[np.float64]:
    """Parameters as a point whose coordinates go from 0 to 1."""
    return np.array([share_of(one, values[one.key]) for one in space])


def share_of(one: Parameter, value: Any) -> float:
    """Where a value lies between its limits, 0 to 1; the inverse of ``at``."""
    if isinstance(one, Choices):
        return one.values.index(value) / max(1, len(one.values) - 1)
    if isinstance(one, Range) and one.log:
        return float(np.log(value / one.low) / np.log(one.high / one.low))
    return float((value - one.low) / (one.high - one.low))


def winner(records: Sequence[Record], arm: str) -> dict[str, Any] | None:
    """The candidate of an arm with the highest mean merit over the heats; ``None`` without any."""
    heats: dict[int, list[Record]] = {}
    for record in records:
        if record.slot.stage == SHORTLIST and record.slot.arm == arm:
            heats.setdefault(record.slot.candidate, []).append(record)
    if not heats:
        return None
    best = max(heats, key=lambda n: float(np.mean([r.merit for r in heats[n]])))
    return heats[best][0].values
