"""From afar to within reach of the fine solver: few low modes first, then all, then many starts."""

from __future__ import annotations

from collections.abc import Generator
from itertools import product

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.matrix import InteractionMatrix
from escape_hw.api.model import DifferentiableModel, SyntheticModel
from escape_hw.calibration.light import LightFit, LightProblem
from escape_hw.calibration.weighted import WeightedMatrix

#: Share of what noise leaves to explain that a registration must explain to be believed.
EXPLAINED = 0.8
#: Modes of the coarse descent: the smoother they are, the farther it reaches.
COARSE = 5
#: Starts of the last resort, in sub-apertures and degrees, and how many of the best are followed.
_SHIFTS = 150.0 * np.arange(-4, 5)
_ROTATIONS = np.array([-10.0, -5.0, 0.0, 5.0, 10.0])
_FOLLOWED = 4
#: Iterations of each of these: what starts near its goal needs no more.
_FEWER = 10


def believable(problem: LightProblem, fit: LightFit) -> bool:
    """Whether a fit explains what it should."""
    weighted = problem.weighted
    return fit.gain > 0 and weighted.explained(fit.residual) >= EXPLAINED * weighted.explicable


def capture(
    matrix: InteractionMatrix,
    model: SyntheticModel,
    columns: NDArray[np.intp],
    start: NDArray[np.float64],
    iterations: int,
    learning_rate: float = 1.0,
    frozen: bool = False,
) -> Generator[LightFit, None, LightFit]:
    """Descend to the registration of a matrix, from wherever it may be.

    The basin of a mode is as wide as its features: five low modes converge from three actuator
    pitches, forty from one. So the lowest of the columns go first and hand over to all of them. If
    that does not explain the matrix, starts all over the field are compared; only for a model that
    gives few modes quickly, for there are hundreds of them.

    Parameters
    ----------
    matrix, model
        The measured matrix and the model that is to explain it.
    columns
        Which columns to use.
    start
        Registration to start from ``(5,)``.
    iterations
        Iterations of each descent before giving up.
    learning_rate
        Share of each step that is taken.
    frozen
        Whether the descent on all columns keeps the derivatives of its start.

    Returns
    -------
    LightFit
        The best that was found, on all columns. Every step on the way is yielded.
    """
    fine = LightProblem(WeightedMatrix.of(matrix, columns), model, learning_rate, frozen)
    coarse = low_modes(matrix, model, columns, learning_rate) or fine
    best = yield from _coarse_to_fine(coarse, fine, start, iterations)
    if believable(fine, best) or not isinstance(model, DifferentiableModel):
        return best
    for place in _promising(coarse):
        found = yield from _coarse_to_fine(coarse, fine, place, min(iterations, _FEWER))
        if found.cost < best.cost:
            best = found
        if believable(fine, best):
            break
    return best


def low_modes(
    matrix: InteractionMatrix, model: SyntheticModel, columns: NDArray[np.intp], learning_rate: float = 1.0
) -> LightProblem | None:
    """The problem of the lowest of the columns; ``None`` where there are too few to leave some out."""
    if columns.size <= 2 * COARSE:
        return None
    return LightProblem(WeightedMatrix.of(matrix, np.sort(columns)[:COARSE]), model, learning_rate)


def _coarse_to_fine(
    coarse: LightProblem, fine: LightProblem, start: NDArray[np.float64], iterations: int
) -> Generator[LightFit, None, LightFit]:
    if coarse is not fine:
        start = (yield from coarse.descend(start, iterations)).alpha
    return (yield from fine.descend(start, iterations))


def _promising(problem: LightProblem) -> list[NDArray[np.float64]]:
    """The starts that explain most of the matrix as they are."""
    places = [np.array([x, y, turn, 0.0, 0.0]) for x, y, turn in product(_SHIFTS, _SHIFTS, _ROTATIONS)]
    explained = [problem.explained(place) for place in places]
    return [places[k] for k in np.argsort(explained)[::-1][:_FOLLOWED]]
