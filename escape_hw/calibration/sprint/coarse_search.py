"""From afar to within reach of the fine solver: few low modes first, then all, then many starts."""

from __future__ import annotations

from collections.abc import Generator
from itertools import product

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.synthetic_model import DifferentiableModel, SyntheticModel
from escape_hw.calibration.sprint.least_squares import LeastSquaresFit, LeastSquaresProblem
from escape_hw.calibration.sprint.weighted_matrix import WeightedMatrix

#: Share of what noise leaves to explain that a registration must explain to be believed.
MIN_EXPLAINED_FRACTION = 0.8
#: Modes of the coarse descent: the smoother they are, the farther it reaches.
N_COARSE_MODES = 5
#: Starts of the last resort, in sub-apertures and degrees, and how many of the best are followed.
_SHIFTS = 150.0 * np.arange(-4, 5)
_ROTATIONS = np.array([-10.0, -5.0, 0.0, 5.0, 10.0])
_N_FOLLOWED = 4
#: Iterations of each of these: what starts near its goal needs no more.
_FINE_ITERATIONS = 10


def is_explained(problem: LeastSquaresProblem, fit: LeastSquaresFit) -> bool:
    """Whether a fit explains what it should."""
    weighted = problem.weighted
    return (
        fit.gain > 0
        and weighted.explained_fraction(fit.residual) >= MIN_EXPLAINED_FRACTION * weighted.signal_fraction
    )


def search_registration(
    matrix: InteractionMatrix,
    model: SyntheticModel,
    columns: NDArray[np.intp],
    start: NDArray[np.float64],
    iterations: int,
    learning_rate: float = 1.0,
    frozen: bool = False,
) -> Generator[LeastSquaresFit, None, LeastSquaresFit]:
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
    fine = LeastSquaresProblem(WeightedMatrix.of(matrix, columns), model, learning_rate, frozen)
    coarse = low_mode_problem(matrix, model, columns, learning_rate) or fine
    best = yield from _coarse_to_fine(coarse, fine, start, iterations)
    if is_explained(fine, best) or not isinstance(model, DifferentiableModel):
        return best
    for grid_point in _best_starts(coarse):
        candidate = yield from _coarse_to_fine(coarse, fine, grid_point, min(iterations, _FINE_ITERATIONS))
        if candidate.cost < best.cost:
            best = candidate
        if is_explained(fine, best):
            break
    return best


def low_mode_problem(
    matrix: InteractionMatrix, model: SyntheticModel, columns: NDArray[np.intp], learning_rate: float = 1.0
) -> LeastSquaresProblem | None:
    """The problem of the lowest of the columns; ``None`` where there are too few to leave some out."""
    if columns.size <= 2 * N_COARSE_MODES:
        return None
    return LeastSquaresProblem(
        WeightedMatrix.of(matrix, np.sort(columns)[:N_COARSE_MODES]), model, learning_rate
    )


def _coarse_to_fine(
    coarse: LeastSquaresProblem, fine: LeastSquaresProblem, start: NDArray[np.float64], iterations: int
) -> Generator[LeastSquaresFit, None, LeastSquaresFit]:
    if coarse is not fine:
        start = (yield from coarse.descend(start, iterations)).alpha
    return (yield from fine.descend(start, iterations))


def _best_starts(problem: LeastSquaresProblem) -> list[NDArray[np.float64]]:
    """The starts that explain most of the matrix as they are."""
    places = [np.array([x, y, turn, 0.0, 0.0]) for x, y, turn in product(_SHIFTS, _SHIFTS, _ROTATIONS)]
    explained_fraction = [problem.explained_fraction(grid_point) for grid_point in places]
    return [places[k] for k in np.argsort(explained_fraction)[::-1][:_N_FOLLOWED]]
