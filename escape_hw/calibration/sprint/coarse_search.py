"""Coarse search for the registration: low modes first, then all modes, then a grid of starting points."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.registration import Registration
from escape_hw.api.synthetic_model import DifferentiableModel, SyntheticModel
from escape_hw.calibration.modes.derivatives import modal_matrix
from escape_hw.calibration.sprint.least_squares import LeastSquaresFit, LeastSquaresProblem
from escape_hw.calibration.sprint.weighted_matrix import WeightedMatrix

#: Fraction of the signal that a registration must explain to be accepted.
MIN_EXPLAINED_FRACTION = 0.8
#: Modes of the coarse descent; smoother modes have a wider basin of convergence.
N_COARSE_MODES = 5
#: Effective number of actuators in a column, as fraction of all, below which the columns are no modes.
_LOCAL = 0.15
#: Relative singular value of the model's matrix below which a combination of columns is left out.
_SINGULAR = 0.1
#: Grid of starting points, in % of a sub-aperture and degrees, and number of the best to descend from.
_SHIFTS = 150.0 * np.arange(-4, 5)
_ROTATIONS = np.array([-10.0, -5.0, 0.0, 5.0, 10.0])
_N_FOLLOWED = 4
#: Iterations of these descents.
_FINE_ITERATIONS = 10


def is_explained(problem: LeastSquaresProblem, fit: LeastSquaresFit) -> bool:
    """Whether a fit has a positive gain and explains the signal."""
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
    """Descend to the registration of a matrix from far away.

    The basin of convergence of a mode is as wide as its features: five low modes converge from three
    actuator pitches, forty from one. So the lowest columns are fitted first, then all of them. If the
    result does not explain the matrix, hundreds of starting points are compared, for differentiable models
    only, which compute few modes quickly. Slope weights are ignored.

    Parameters
    ----------
    matrix, model, columns
        The measured matrix, the model to fit, and the columns to use.
    start
        Initial registration ``(5,)``.
    iterations, learning_rate
        Limit of the iterations of each descent, and fraction of each step that is taken.
    frozen
        Whether the descent on all columns keeps the derivatives of its start.

    Returns
    -------
    LeastSquaresFit
        The best fit of all columns. Every accepted step is yielded.
    """
    fine = LeastSquaresProblem(WeightedMatrix.from_columns(matrix, columns), model, learning_rate, frozen)
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
    """The problem of the lowest modes; ``None`` if there are too few columns to omit some."""
    if columns.size <= 2 * N_COARSE_MODES:
        return None
    return LeastSquaresProblem(weigh_low_modes(matrix, model, columns), model, learning_rate)


def weigh_low_modes(
    matrix: InteractionMatrix, model: SyntheticModel, columns: NDArray[np.intp]
) -> WeightedMatrix:
    """The lowest modes of a matrix, weighted.

    These are its first columns. If single actuators or small groups move in them, as in a zonal matrix, they
    are the combinations of columns with which the model makes tilts, focus and astigmatism.
    """
    columns = np.sort(columns)
    if not _is_local(matrix.m2c[:, columns]):
        return WeightedMatrix.from_columns(matrix, columns[:N_COARSE_MODES])
    m2c = matrix.m2c[:, columns]
    nominal = modal_matrix(model, Registration(), m2c)
    combination = np.linalg.lstsq(nominal, _low_order_slopes(matrix.valid), rcond=_SINGULAR)[0]
    combined = replace(
        matrix,
        data=(matrix.data[:, columns] @ combination).astype(np.float32),
        sigma=np.sqrt(matrix.sigma[:, columns].astype(float) ** 2 @ combination**2).astype(np.float32),
        m2c=m2c @ combination,
    )
    return WeightedMatrix.from_columns(combined, np.arange(N_COARSE_MODES))


def _is_local(m2c: NDArray[np.float64]) -> bool:
    """Whether a few actuators dominate in the typical column ``(n_act, n)``."""
    power = m2c**2
    effective = power.sum(axis=0) ** 2 / np.maximum((power**2).sum(axis=0), np.finfo(float).tiny)
    return float(np.median(effective)) < _LOCAL * len(m2c)


def _low_order_slopes(valid: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Slopes ``(n_slopes, 5)`` of two tilts, focus and two astigmatisms."""
    y, x = (np.argwhere(valid) - (np.array(valid.shape) - 1) / 2).T / (max(valid.shape) / 2)
    one, zero = np.ones_like(x), np.zeros_like(x)
    along_x, along_y = (one, zero, x, x, y), (zero, one, y, -y, x)
    return np.concatenate([np.stack(along_x, axis=1), np.stack(along_y, axis=1)])


def _coarse_to_fine(
    coarse: LeastSquaresProblem, fine: LeastSquaresProblem, start: NDArray[np.float64], iterations: int
) -> Generator[LeastSquaresFit, None, LeastSquaresFit]:
    if coarse is not fine:
        start = (yield from coarse.descend(start, iterations)).alpha
    return (yield from fine.descend(start, iterations))


def _best_starts(problem: LeastSquaresProblem) -> list[NDArray[np.float64]]:
    """The starting points of the grid that explain most of the matrix."""
    grid = [np.array([x, y, turn, 0.0, 0.0]) for x, y, turn in product(_SHIFTS, _SHIFTS, _ROTATIONS)]
    explained = [problem.explained_fraction(point) for point in grid]
    return [grid[k] for k in np.argsort(explained)[::-1][:_N_FOLLOWED]]
