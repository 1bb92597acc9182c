"""Flips and quarter turns that no registration can undo: which of them would explain a matrix."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.matrix import InteractionMatrix
from escape_hw.api.model import DifferentiableModel, SyntheticModel
from escape_hw.calibration.capture import COARSE, EXPLAINED
from escape_hw.calibration.light import LightProblem
from escape_hw.calibration.weighted import WeightedMatrix

#: How the sensor would see the pupil, and the map of (row, column) offsets from the middle.
_VIEWS = {
    "mirrored left to right": ((1, 0), (0, -1)),
    "upside down": ((-1, 0), (0, 1)),
    "turned by 180 degrees": ((-1, 0), (0, -1)),
    "turned by 90 degrees": ((0, -1), (1, 0)),
    "turned by 270 degrees": ((0, 1), (-1, 0)),
    "transposed": ((0, 1), (1, 0)),
    "transposed about the other diagonal": ((0, -1), (-1, 0)),
}
_ITERATIONS = 10


def parity_hint(matrix: InteractionMatrix, model: SyntheticModel, columns: NDArray[np.intp]) -> str | None:
    """What would explain a matrix that no registration explains.

    Parameters
    ----------
    matrix, model, columns
        As for SPRINT.

    Returns
    -------
    str or None
        A sentence for the operator; ``None`` if nothing helps, or if the model is too slow to try.
    """
    if not isinstance(model, DifferentiableModel):
        return None
    weighted = WeightedMatrix.of(matrix, np.sort(columns)[:COARSE])
    for view, seen in _seen_otherwise(weighted):
        problem = LightProblem(seen, model)
        *_, fit = problem.descend(np.zeros(5), _ITERATIONS)
        if seen.explained(fit.residual) >= EXPLAINED * seen.explicable:
            sign = " and the polarity were reversed" if fit.gain < 0 else ""
            return f"it would if the sensor saw the pupil {view}{sign}; check the layout and the flips"
    return None


def _seen_otherwise(weighted: WeightedMatrix) -> Iterator[tuple[str, WeightedMatrix]]:
    """The matrix as a sensor turned or flipped would have seen it; slopes it would not have are left out."""
    valid = weighted.valid
    number = np.full(valid.shape, -1)
    number[valid] = np.arange(int(valid.sum()))
    middle = (np.array(valid.shape) - 1) / 2
    here = np.argwhere(valid)
    n = len(here)
    for view, turn in _VIEWS.items():
        way = np.array(turn)
        if valid.shape[0] != valid.shape[1] and way[0, 0] == 0:
            continue
        there = np.rint((here - middle) @ way.T + middle).astype(int)
        source = number[there[:, 0], there[:, 1]]
        data, noise = np.zeros_like(weighted.data), np.full(2 * n, np.inf)
        # Slopes are vectors (x, y) against offsets (row, column): they turn as the offsets do.
        for half, axis in ((0, 1), (1, 0)):
            along = int(np.flatnonzero(way.T[axis])[0])
            from_half = 1 - along
            rows = np.flatnonzero(source >= 0)
            at = source[rows] + from_half * n
            data[rows + half * n] = way.T[axis, along] * weighted.data[at]
            noise[rows + half * n] = weighted.by_slope[at]
        yield view, replace(weighted, data=data, by_slope=noise)
