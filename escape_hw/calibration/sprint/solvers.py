"""The solvers of SPRINT behind one function, :func:`solve`.

The registration-only solvers are in :mod:`~.least_squares`; the Gauss-Newton iteration of the mixed-effects
fit is here, its problem in :mod:`~.mixed_effects`.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.procedure import Procedure, Progress, Reporter
from escape_hw.api.registration import TO_STREAM_UNITS, Registration
from escape_hw.api.results import ActuatorCorrections, SprintIteration
from escape_hw.api.synthetic_model import HasPokeResponse, HasSlopeWeights, SyntheticModel
from escape_hw.calibration.sprint.coarse_search import low_mode_problem, search_registration
from escape_hw.calibration.sprint.covariance import LinearisedProblem
from escape_hw.calibration.sprint.extra_parameters import (
    ExtraParameterModel,
    FittedExtraParameter,
    build_fitted_extra_parameters,
)
from escape_hw.calibration.sprint.least_squares import (
    NEGLIGIBLE_STEP,
    BatchProblem,
    DiagonalProblem,
    LeastSquaresFit,
    LeastSquaresProblem,
)
from escape_hw.calibration.sprint.mixed_effects import MixedEffectsProblem, MixedEffectsState, PriorEstimate
from escape_hw.calibration.sprint.normal_equations import NormalEquations, Priors
from escape_hw.calibration.sprint.weighted_matrix import WeightedMatrix
from escape_hw.config.choices import Solver

T = TypeVar("T")

#: Largest step of a mixed-effects iteration, in the units of the parameters: the model is only locally
#: linear, and more so with random effects, so it is half that of the registration-only solvers. Step norms
#: of all solvers are in this unit.
MAX_STEP = np.array([60.0, 60.0, 2.0, 4.0, 4.0])
#: A step is damped more and more strongly while its cost exceeds the lowest so far by more than this factor.
#: In a matrix that is mostly noise, 2 % more are a thousand times the square of a standard error: with that
#: tolerance the width and the shape of the influence functions went astray along their degeneracy.
_DAMPINGS, _COST_TOLERANCE = (0.0, 1.0, 8.0, 64.0, 512.0, 4096.0, 32768.0), 1.001
#: A rough fit ends when the cost falls by less than to this factor.
_ROUGH_CHANGE = 0.999
#: A cost that is extrapolated to so many times the limit shows that a step is too long.
_MAX_EXCESS = 2.0
#: Oscillating steps are shortened down to this fraction of the learning rate, and so many times; then the
#: descent gives up.
_MIN_RATE_FRACTION, _MAX_REVERSALS = 0.125, 12
#: Solvers that group or scale the columns as modes, and so need a matrix rather than telemetry.
MATRIX_ONLY_SOLVERS: tuple[Solver, ...] = ("batches", "diagonal")


@dataclass(slots=True, eq=False)
class SolverContext:
    """Inputs of a fit, as for :func:`~.fit.fit_registration`, and its iterations."""

    matrix: InteractionMatrix
    model: SyntheticModel
    columns: NDArray[np.intp]
    solver: Solver
    learning_rate: float
    max_iterations: int
    priors: Priors
    extras: tuple[ExtraParameterModel, ...] = ()
    usual_priors: Priors = field(default_factory=Priors)
    checks_orientation: bool = True
    history: list[SprintIteration] = field(default_factory=list)
    report: Reporter = field(init=False)
    problem: MixedEffectsProblem | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        self.report = Reporter("SPRINT", self.max_iterations, "iteration")

    def use_pokes(self, alpha: NDArray[np.float64]) -> bool:
        """Replace the model by the one around the pokes at ``alpha (5,)``; whether there is one."""
        if not isinstance(self.model, HasPokeResponse):
            return False
        # A mean delay of 1.2 frames: during a fifth of an exposure the mirror still has the poke before.
        overlap = float(self.matrix.metrics.get("delay_frames", 0.0)) % 1
        model = self.model.around_pokes(Registration.from_array(alpha), self.matrix.m2c, overlap)
        if model is None:
            return False
        self.model, self.problem = model, None
        self.extras = build_fitted_extra_parameters(model, [one.name for one in self.extras])
        return True

    def progress(self, sigma: NDArray[np.float64] | None = None) -> Progress:
        """The iterations so far, and the standard errors of the last one ``(5,)``, NaN while unknown."""
        rows = np.array([step.registration.to_array() for step in self.history]).reshape(-1, 5)
        errors = np.full(5, np.nan) if sigma is None else sigma
        arrays = {
            "registration": (rows * TO_STREAM_UNITS).astype(np.float32),
            "registration_sigma": (errors * TO_STREAM_UNITS).astype(np.float32),
            "step_norm": np.array([step.step_norm for step in self.history], np.float32),
        }
        return self.report.now(arrays)


@dataclass(frozen=True, slots=True, eq=False)
class SprintSolution:
    """Result of any solver.

    Parameters
    ----------
    system
        The linearised problem at the solution.
    alpha, gain, width
        Registration ``(5,)``, gain and relative width of the influence functions.
    steps_converged
        Whether the steps became negligible.
    zonal_matrix
        Computes the fitted matrix ``(n_slopes, n_act)``.
    added_covariance
        To be added to the covariance of the registration ``(5, 5)``.
    estimate_priors, actuator_corrections
        Compute the scatter of the random effects and the corrections of the actuators; ``None`` for
        solvers without random effects.
    extras
        The fitted extra parameters.
    remaining_step
        The full step of the registration at the end ``(5,)``.
    state
        Values of all parameters and random effects; ``None`` for solvers without random effects.
    excess_scatters
        Groups of effects of the mirror that scatter by more than their priors can, and by how many times.
    """

    system: LinearisedProblem
    alpha: NDArray[np.float64]
    gain: float
    width: float
    steps_converged: bool
    zonal_matrix: Callable[[], NDArray[np.float64]]
    added_covariance: NDArray[np.float64] | None = None
    estimate_priors: Callable[[], PriorEstimate] | None = None
    extras: tuple[FittedExtraParameter, ...] = ()
    actuator_corrections: Callable[[], ActuatorCorrections] | None = None
    remaining_step: NDArray[np.float64] | None = None
    state: MixedEffectsState | None = None
    excess_scatters: Mapping[str, float] = field(default_factory=dict)


def solve(
    context: SolverContext,
    weighted: WeightedMatrix,
    start: NDArray[np.float64],
    coarse_search: bool,
    state: MixedEffectsState | None = None,
    rough: bool = False,
) -> Procedure[SprintSolution]:
    """Solve for weighted columns, from a registration ``start (5,)``, with the solver of the context.

    The iterations are recorded in the context. With ``coarse_search`` the start is searched from far away.
    A ``state`` of an earlier solution is where the mixed-effects fit starts. A ``rough`` one ends as soon as
    its cost hardly changes: with usual scatters of the effects, and a model that misfits by many times the
    noise, further iterations wander along degeneracies.
    """
    model, solver, rate = context.model, context.solver, context.learning_rate
    n = context.max_iterations
    context.report = Reporter("SPRINT", n, "iteration")
    if solver in MATRIX_ONLY_SOLVERS:
        low = low_mode_problem(context.matrix, model, context.columns, rate) if coarse_search else None
        if low is not None:
            start = (yield from _record_steps(low.descend(start, n), context)).alpha
        if solver == "diagonal":
            steps = DiagonalProblem(weighted, model, rate).descend(start, n)
            return _solution_from_least_squares((yield from _record_steps(steps, context)), model)
        batches = BatchProblem(weighted, model, rate).descend(start, n)
        fit, added_covariance = yield from _record_steps(batches, context)
        return _solution_from_least_squares(fit, model, added_covariance)
    frozen = solver == "frozen-derivatives"
    if coarse_search:
        search = search_registration(context.matrix, model, context.columns, start, n, rate, frozen)
        fit = yield from _record_steps(search, context)
        start = fit.alpha
    if solver == "mixed-effects":
        problem = context.problem = MixedEffectsProblem(
            weighted,
            model,
            context.priors,
            extras=context.extras,
            earlier=context.problem,
            usual_priors=context.usual_priors,
        )
        state = state or problem.initial_state(Registration.from_array(start))
        solution = yield from _fit_mixed_effects(problem, state, context, rough)
        # The errors follow from the derivatives at the solution itself.
        return replace(solution, system=problem.relinearise(solution.state or state, solution.system))
    # The coarse search ignores slope weights.
    if not coarse_search or isinstance(model, HasSlopeWeights):
        steps = LeastSquaresProblem(weighted, model, rate, frozen).descend(start, n)
        fit = yield from _record_steps(steps, context)
    return _solution_from_least_squares(fit, model)


def _solution_from_least_squares(
    fit: LeastSquaresFit, model: SyntheticModel, added_covariance: NDArray[np.float64] | None = None
) -> SprintSolution:
    def zonal_matrix() -> NDArray[np.float64]:
        return np.asarray(fit.gain * model.zonal_matrix(Registration.from_array(fit.alpha)))

    return SprintSolution(fit, fit.alpha, fit.gain, 1.0, fit.steps_converged, zonal_matrix, added_covariance)


def _record_steps(steps: Generator[LeastSquaresFit, None, T], context: SolverContext) -> Procedure[T]:
    """Record the steps of a descent and report its progress."""
    while True:
        try:
            fit = next(steps)
        except StopIteration as done:
            last: T = done.value
            return last
        norm = float(np.linalg.norm(fit.step / MAX_STEP))
        context.history.append(_iteration_record(fit.alpha, fit.gain, fit.residual, norm))
        if context.report.step():
            yield context.progress()


def _fit_mixed_effects(
    problem: MixedEffectsProblem, state: MixedEffectsState, context: SolverContext, rough: bool = False
) -> Procedure[SprintSolution]:
    """Gauss-Newton iteration on registration and random effects together, from a state."""
    system, steps_converged = problem.linearise(state), False
    rate, previous_step, reversals = context.learning_rate, np.zeros(5), 0
    lowest_cost = _cost(problem, state, system.residual)
    for _ in range(context.max_iterations):
        if context.report.step():
            yield context.progress()
        step = system.solve()
        remaining_step = step[1:6]
        if not np.isfinite(step).all():
            break
        spread = np.sqrt(np.abs(np.diag(np.linalg.inv(system.information()))))[1:6]
        spread *= problem.weighted.noise_level(system.residual)
        relative = np.abs(step[1:6]) / np.maximum(NEGLIGIBLE_STEP, 0.02 * spread)
        norm = float(np.linalg.norm(step[1:6] / MAX_STEP))
        context.history.append(_iteration_record(state.alpha, state.gain, system.residual, norm))
        if relative.max() < 1.0:
            steps_converged = True
            break
        if step[1:6] / MAX_STEP @ previous_step < -0.5 * (previous_step @ previous_step):
            # Oscillation: nonlinearity of the model reverses each step.
            rate, reversals = rate / 2, reversals + 1
            if rate < _MIN_RATE_FRACTION * context.learning_rate or reversals > _MAX_REVERSALS:
                break
        elif norm < np.linalg.norm(previous_step):
            rate = min(2 * rate, context.learning_rate)
        previous_step = step[1:6] / MAX_STEP
        shortening = min(1.0, 1.0 / float(np.max(np.abs(step[1:6]) / MAX_STEP)))
        largest_cost = _COST_TOLERANCE * lowest_cost
        trial = _take_step(problem, state, system, step, shortening * rate, largest_cost)
        if trial is None:
            break
        state, system = trial
        cost, previous_cost = _cost(problem, state, system.residual), lowest_cost
        lowest_cost = min(lowest_cost, cost)
        if rough and cost > _ROUGH_CHANGE * previous_cost:
            break
    else:
        # Not the last step, which was a fraction of the full one, but the full step from where it led.
        remaining_step = system.solve()[1:6]
    return SprintSolution(
        system, state.alpha, state.gain, 1 + state.width, steps_converged,
        lambda: problem.zonal_matrix(state),
        estimate_priors=lambda: problem.estimate_priors(state, system),
        actuator_corrections=lambda: problem.actuator_corrections(state, system),
        extras=problem.extra_parameter_values(state),
        remaining_step=remaining_step, state=state,
        excess_scatters=problem.excess_scatters(state, system),
    )  # fmt: skip


def _take_step(
    problem: MixedEffectsProblem,
    state: MixedEffectsState,
    system: NormalEquations,
    step: NDArray[np.float64],
    fraction: float,
    largest_cost: float,
) -> tuple[MixedEffectsState, NormalEquations] | None:
    """The state after a fraction of a system's step, damped until its cost is at most ``largest_cost``.

    ``None`` if it stays larger. The problem is bilinear in gain, shares and effects. Far from the solution,
    and along directions that only the priors determine, a full step may overshoot: it is damped as by
    Levenberg (1944) and Marquardt (1963), in units of the priors.
    """
    for damping in _DAMPINGS:
        if damping:
            step = system.solve_damped(damping, problem.offset(state))
        trial_state = problem.move(state, fraction * step)
        # Most of the time of a step goes into derivatives, which a step that is too long does not need.
        if (
            _cost(problem, trial_state, problem.extrapolate_residual(trial_state))
            > _MAX_EXCESS * largest_cost
        ):
            continue
        trial_system = problem.linearise(trial_state)
        if _cost(problem, trial_state, trial_system.residual) <= largest_cost:
            return trial_state, trial_system
    return None


def _cost(problem: MixedEffectsProblem, state: MixedEffectsState, residual: NDArray[np.float64]) -> float:
    """Sum of squares of a residual and of the distances from the priors, in standard errors."""
    offset = problem.offset(state)
    return float(np.vdot(residual, residual) + offset @ (problem.precision * offset))


def _iteration_record(
    alpha: NDArray[np.float64], gain: float, residual: NDArray[np.float64], norm: float
) -> SprintIteration:
    chi2 = float(np.mean(np.square(residual)))
    return SprintIteration(Registration.from_array(alpha), gain, norm, chi2)
