"""The ways in which SPRINT solves its problem, each behind the same few words."""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.departures import MirrorDepartures
from escape_hw.api.matrix import InteractionMatrix
from escape_hw.api.model import SelectiveModel, SyntheticModel
from escape_hw.api.procedure import Procedure, Progress, Reporter
from escape_hw.api.registration import TO_PLAIN, Registration
from escape_hw.api.results import SprintIteration
from escape_hw.calibration.batches import BatchProblem
from escape_hw.calibration.capture import capture, low_modes
from escape_hw.calibration.covariance import Linearised
from escape_hw.calibration.diagonal import DiagonalProblem
from escape_hw.calibration.extra_unknowns import ExtraUnknown, FoundExtra
from escape_hw.calibration.light import SMALL, LightFit, LightProblem
from escape_hw.calibration.linearisation import Learned, Problem, State
from escape_hw.calibration.misfit import NormalEquations, Priors
from escape_hw.calibration.weighted import WeightedMatrix
from escape_hw.config.models import Solver

T = TypeVar("T")

#: Largest move in one iteration: the model is only locally linear.
LARGEST = np.array([60.0, 60.0, 2.0, 4.0, 4.0])
#: A step is halved, so many times at most, as long as it makes squares grow by more than this factor.
_HALVINGS, _WORSE = 6, 1.02
#: Steps that go to and fro are shortened down to this share, beyond which it is hopeless.
_LEAST_RATE = 0.125
#: Solvers that take the columns for modes, and so need a matrix.
BY_MODES: tuple[Solver, ...] = ("batches", "diagonal")


@dataclass(slots=True, eq=False)
class Descent:
    """What is the same for every solver of one matrix, and the steps that were taken.

    Parameters
    ----------
    matrix, model, columns
        The measured matrix, the model, and which columns to fit.
    solver, learning_rate, max_iterations, priors
        As for :func:`~escape_hw.calibration.sprint.sprint`.
    extras
        What to fit beside the registration.
    """

    matrix: InteractionMatrix
    model: SyntheticModel
    columns: NDArray[np.intp]
    solver: Solver
    learning_rate: float
    max_iterations: int
    priors: Priors
    extras: tuple[ExtraUnknown, ...] = ()
    history: list[SprintIteration] = field(default_factory=list)
    report: Reporter = field(init=False)

    def __post_init__(self) -> None:
        self.report = Reporter("SPRINT", self.max_iterations, "iteration")

    def progress(self, sigma: NDArray[np.float64] | None = None) -> Progress:
        """The iterations so far; with the standard errors of the last ``(5,)`` once they are known."""
        rows = np.array([step.registration.to_array() for step in self.history]).reshape(-1, 5)
        errors = np.full(5, np.nan) if sigma is None else sigma
        arrays = {
            "registration": (rows * TO_PLAIN).astype(np.float32),
            "registration_sigma": (errors * TO_PLAIN).astype(np.float32),
            "step_norm": np.array([step.step_norm for step in self.history], np.float32),
        }
        return self.report.now(arrays)


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Where a descent ended, alike for every solver.

    ``zonal`` gives the matrix that was found ``(n_slopes, n_act)``, ``learned`` what the data say about the
    scatter of the random effects, and ``departures`` those of the mirror, where there are any; each is
    worked out when asked for. ``scatter`` is what is to be added to the covariance of the registration
    ``(5, 5)``; ``extras`` is what was fitted beside it; ``left`` is the whole step from where it
    ended ``(5,)``.
    """

    system: Linearised
    alpha: NDArray[np.float64]
    gain: float
    width: float
    settled: bool
    zonal: Callable[[], NDArray[np.float64]]
    scatter: NDArray[np.float64] | None = None
    learned: Callable[[], Learned] | None = None
    extras: tuple[FoundExtra, ...] = ()
    departures: Callable[[], MirrorDepartures] | None = None
    left: NDArray[np.float64] | None = None


def solve(
    descent: Descent, weighted: WeightedMatrix, start: NDArray[np.float64], reach: bool
) -> Procedure[Solution]:
    """Solve for a weighted matrix.

    Parameters
    ----------
    descent
        Matrix, model and how to solve; the steps are kept there.
    weighted
        The columns, weighted.
    start
        Registration to start from ``(5,)``.
    reach
        Whether to come from afar first.
    """
    model, rate, most = descent.model, descent.learning_rate, descent.max_iterations
    if descent.solver in BY_MODES:
        low = low_modes(descent.matrix, model, descent.columns, rate) if reach else None
        if low is not None:
            start = (yield from _watched(low.descend(start, most), descent)).alpha
        if descent.solver == "diagonal":
            return _of_light(
                (yield from _watched(DiagonalProblem(weighted, model, rate).descend(start, most), descent)),
                model,
            )
        steps = BatchProblem(weighted, model, rate).descend(start, most)
        fit, scatter = yield from _watched(steps, descent)
        return _of_light(fit, model, scatter)
    frozen = descent.solver == "frozen"
    if reach:
        far = capture(descent.matrix, model, descent.columns, start, most, rate, frozen)
        light = yield from _watched(far, descent)
        start = light.alpha
    # From afar all slopes count, those that the model is none of, too.
    if descent.solver != "effects" and (not reach or isinstance(model, SelectiveModel)):
        light = yield from _watched(LightProblem(weighted, model, rate, frozen).descend(start, most), descent)
    if descent.solver != "effects":
        return _of_light(light, model)
    problem = Problem(weighted, model, descent.priors, extras=descent.extras)
    return (yield from _with_effects(problem, Registration.from_array(start), descent))


def _of_light(fit: LightFit, model: SyntheticModel, scatter: NDArray[np.float64] | None = None) -> Solution:
    def zonal() -> NDArray[np.float64]:
        return np.asarray(fit.gain * model.zonal_matrix(Registration.from_array(fit.alpha)))

    return Solution(fit, fit.alpha, fit.gain, 1.0, fit.settled, zonal, scatter)


def _watched(steps: Generator[LightFit, None, T], descent: Descent) -> Procedure[T]:
    """Hand on the progress of a descent and keep its steps."""
    while True:
        try:
            fit = next(steps)
        except StopIteration as done:
            last: T = done.value
            return last
        norm = float(np.linalg.norm(fit.step / LARGEST))
        descent.history.append(_record(fit.alpha, fit.gain, fit.residual, norm))
        if descent.report.step():
            yield descent.progress()


def _with_effects(problem: Problem, start: Registration, descent: Descent) -> Procedure[Solution]:
    """Gauss-Newton on registration and random effects together."""
    state, settled = problem.start(start), False
    system = problem.linearise(state)
    rate, before = descent.learning_rate, np.zeros(5)
    for _ in range(descent.max_iterations):
        if descent.report.step():
            yield descent.progress()
        step = system.solve()
        left = step[1:6]
        if not np.isfinite(step).all():
            break
        spread = np.sqrt(np.abs(np.diag(np.linalg.inv(system.information()))))[1:6]
        spread *= problem.weighted.noise(system.residual)
        relative = np.abs(step[1:6]) / np.maximum(SMALL, 0.02 * spread)
        norm = float(np.linalg.norm(step[1:6] / LARGEST))
        descent.history.append(_record(state.alpha, state.gain, system.residual, norm))
        if relative.max() < 1.0:
            settled = True
            break
        if step[1:6] / LARGEST @ before < -0.5 * (before @ before):
            # To and fro: what the model is not linear in sends each step back by as much as the last.
            rate /= 2
            if rate < _LEAST_RATE * descent.learning_rate:
                break
        before = step[1:6] / LARGEST
        damping = min(1.0, 1.0 / float(np.max(np.abs(step[1:6]) / LARGEST)))
        step = step * damping * rate
        state, system = _moved(problem, state, system, step)
    else:
        # The last step was a share of what was wanted then; this is what is wanted now.
        left = system.solve()[1:6]
    return Solution(
        system, state.alpha, state.gain, 1 + state.width, settled,
        lambda: problem.zonal(state), learned=lambda: problem.learned(state, system),
        extras=problem.extras_found(state), departures=lambda: problem.departures(state, system),
        left=left,
    )  # fmt: skip


def _moved(
    problem: Problem, state: State, system: NormalEquations, step: NDArray[np.float64]
) -> tuple[State, NormalEquations]:
    """The state after a step, or after a part of it where the whole would make things clearly worse.

    Gain and shares multiply: on a pyramid that is far from its model at rest a whole step may end where
    the model is another one.
    """
    bearable = _WORSE * _cost(problem, state, system)
    for _ in range(_HALVINGS):
        moved = problem.move(state, step)
        found = problem.linearise(moved)
        if _cost(problem, moved, found) <= bearable:
            break
        step = step / 2
    return moved, found


def _cost(problem: Problem, state: State, system: NormalEquations) -> float:
    """Squares of what is left and of the distances from the priors, in standard errors."""
    offset = problem.offset(state)
    return float(np.vdot(system.residual, system.residual) + offset @ (problem.precision * offset))


def _record(
    alpha: NDArray[np.float64], gain: float, residual: NDArray[np.float64], norm: float
) -> SprintIteration:
    chi2 = float(np.mean(np.square(residual)))
    return SprintIteration(Registration.from_array(alpha), gain, norm, chi2)
