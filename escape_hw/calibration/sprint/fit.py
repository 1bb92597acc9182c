"""SPRINT: registration of mirror and sensor from a measured interaction matrix.

:func:`sprint` is the whole fit, with standard errors, warnings and the convergence decision;
:func:`fit_registration` is the same as a procedure that reports progress.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypedDict, TypeVar

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.concurrency import limit_to_one_thread
from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.procedure import Procedure
from escape_hw.api.registration import PARAMETERS, Registration
from escape_hw.api.results import Estimate, RegistrationEstimate
from escape_hw.api.synthetic_model import SyntheticModel
from escape_hw.calibration.modes.derivatives import modal_matrix
from escape_hw.calibration.sprint.covariance import sandwich_covariance, systematic_error
from escape_hw.calibration.sprint.description_checks import describe_description, estimate_clocking
from escape_hw.calibration.sprint.diagnostics import describe_degeneracies
from escape_hw.calibration.sprint.extra_parameters import build_extra_parameters
from escape_hw.calibration.sprint.goodness_of_fit import assess_fit, check_fit, describe_misfit
from escape_hw.calibration.sprint.influence_estimate import estimate_profile
from escape_hw.calibration.sprint.mixed_effects import GAIN, SHAPE, WIDTH, MixedEffectsState, PriorEstimate
from escape_hw.calibration.sprint.mode_choice import choose_modes
from escape_hw.calibration.sprint.normal_equations import NormalEquations, Priors
from escape_hw.calibration.sprint.numbering import describe_numbering, numbering_covariance
from escape_hw.calibration.sprint.orientation import find_better_orientation
from escape_hw.calibration.sprint.repeatability import repeatability_covariance
from escape_hw.calibration.sprint.solvers import MAX_STEP, SolverContext, SprintSolution, solve
from escape_hw.calibration.sprint.tip_tilt import TipTiltFreeModel, is_tip_tilt_removed
from escape_hw.calibration.sprint.weighted_matrix import (
    HUBER_ITERATIONS,
    WeightedMatrix,
    apply_model_weights,
    huber_weights,
)
from escape_hw.config.choices import (
    ACTUATOR_MODELS,
    LOSSES,
    MODES_CHOICES,
    SOLVERS,
    ActuatorModel,
    ExtraParameter,
    Loss,
    ModesChoice,
    Solver,
)
from escape_hw.config.renamed import present_value
from escape_hw.config.system import CalibrationSection
from escape_hw.deprecation import renamed_keywords, warn_renamed
from escape_hw.errors import CalibrationError, ConfigError, IncompatibleProduct

T = TypeVar("T")

#: The common parameters, in their order; shares of the model's variants follow.
_PARAMETER_NAMES = ("gain", *PARAMETERS, "width")
#: Remaining step, relative to the stated errors, below which the descent counts as converged.
_NEGLIGIBLE_STEP = 0.05
#: Optional attributes of a model in version 0.1.0 -> present names.
_RENAMED_CAPABILITIES = {
    "registration_doubt": "registration_systematic_error",
    "slope_trust": "slope_weights",
}
_TIP_TILT_NOTE = "the slopes of the matrix have no tip and tilt; those of the model were removed as well"
#: Signal-to-noise ratio of the best mode below which a matrix is refused.
_MIN_SNR = 0.1
#: Differences of real instruments from their model where no configuration gives them.
_USUAL_PRIORS = Priors()


class SprintOptions(TypedDict):
    """Options of :func:`sprint` that a system's configuration sets."""

    modes_choice: ModesChoice
    solver: Solver
    loss: Loss
    actuator_model: ActuatorModel
    learning_rate: float
    extra_parameters: tuple[ExtraParameter, ...]
    usual_priors: Priors


def sprint_options_from_config(section: CalibrationSection) -> SprintOptions:
    """Options of SPRINT from the section ``calibration`` of a configuration."""
    return {
        "modes_choice": section.modes_choice,
        "solver": section.solver,
        "loss": section.loss,
        "actuator_model": section.actuator_model,
        "learning_rate": section.learning_rate,
        "extra_parameters": section.extra_parameters,
        "usual_priors": Priors(**section.priors.model_dump()),
    }


@dataclass(frozen=True, slots=True, eq=False)
class SprintFit:
    """Registration estimate with the matrix that was fitted.

    Parameters
    ----------
    estimate
        Registration and gain, with standard errors.
    zonal_matrix
        Computes the slopes per unit command ``(n_slopes, n_act)`` with everything that was fitted, random
        effects included: the matrix of the real mirror rather than of the nominal one.
    estimate_priors
        Estimates the scatter of the random effects from the data; ``None`` for solvers without them.
    state
        Values of all parameters and random effects, likewise.
    """

    estimate: RegistrationEstimate
    zonal_matrix: Callable[[], NDArray[np.float64]]
    estimate_priors: Callable[[], PriorEstimate] | None = None
    state: MixedEffectsState | None = None


@renamed_keywords(
    choice="modes_choice", learn="update_priors", reach="coarse_search", also="extra_parameters",
    actuators="actuator_model",
)  # fmt: skip
def sprint(
    matrix: InteractionMatrix,
    model: SyntheticModel,
    *,
    modes: NDArray[np.intp] | int | None = None,
    modes_choice: ModesChoice = "snr",
    solver: Solver = "mixed-effects",
    loss: Loss = "squares",
    learning_rate: float = 1.0,
    start: Registration | None = None,
    max_iterations: int = 40,
    covariance: NDArray[np.float64] | None = None,
    priors: Priors | None = None,
    usual_priors: Priors = _USUAL_PRIORS,
    update_priors: bool = True,
    coarse_search: bool = True,
    extra_parameters: Sequence[ExtraParameter] = (),
    actuator_model: ActuatorModel = "fitted",
) -> RegistrationEstimate:
    """Estimate registration and gain from an interaction matrix (paper, SPRINT section).

    Parameters
    ----------
    matrix
        The measured matrix; its standard errors are the weights.
    model
        The synthetic model, built on the same sub-apertures.
    modes
        Columns to use, or number of the best columns; all by default.
    modes_choice
        Criterion of the best columns, see :func:`~.mode_choice.choose_modes`.
    solver
        ``"mixed-effects"``: with actuator gains and widths, slope gains and sampling positions as random
        effects. ``"registration-only"``: gain and registration; several times faster and as accurate for a
        mirror that equals its model; less accurate for a real one, and its errors do not include unequal
        actuators. ``"frozen-derivatives"``: the same with the derivatives of the start.
        ``"batches"``: the paper's fit of a few modes at a time (Eq. argmin_simple). ``"diagonal"``: one gain
        per mode (Eq. argmin_full).
    loss
        ``"squares"``, or ``"huber"``: sub-apertures with outlying residuals have less weight
        (:func:`~.weighted_matrix.huber_weights`).
    learning_rate
        Fraction of each step that is taken, in (0, 1] (paper: gamma).
    start
        Initial registration; zero by default.
    max_iterations
        Limit of the iterations; for ``"batches"``, of the passes through all batches.
    covariance
        Covariance of the noise of the slopes ``(n_slopes, n_slopes)`` up to a factor, where it is known.
        Turbulence correlates neighbouring slopes, which enlarges the errors of the registration. Without it
        the correlation is estimated, less precisely, from the scatter between modes.
    priors
        Prior scatter of the random effects; ``usual_priors`` by default.
    usual_priors
        Their scatter among instruments of a kind. Estimates of the scatter are limited relative to it.
    update_priors
        Estimate that scatter from the data and solve again with it.
    coarse_search
        Search from far away first, low modes before high ones (:mod:`~.coarse_search`). Without it the
        descent starts at ``start`` with all modes.
    extra_parameters
        Parameters to fit in addition (:mod:`~.extra_parameters`); mixed-effects fit only.
    actuator_model
        ``"fitted"``: the estimate keeps the fitted corrections of the actuators, and a pseudo-synthetic
        matrix computed from it contains them. ``"nominal"``: it does not, and the matrix is that of the
        nominal actuators. The fit is the same.

    Returns
    -------
    RegistrationEstimate
        ``converged`` is false when the steps did not become small or the model does not explain the
        matrix; ``warnings`` states the reason. ``model_fits`` is false when the model leaves more than the
        noise and the priors allow; ``notes`` name what does not fit, and the standard errors contain it.

    Raises
    ------
    IncompatibleProduct
        Matrix and model have different actuators or sub-apertures.
    CalibrationError
        The matrix is zero, not finite, or noise only.
    ConfigError
        The model or the solver does not support one of ``extra_parameters``.
    ValueError
        A learning rate outside (0, 1]; modes that do not exist; an unknown solver, choice, loss or
        actuator model.
    """
    steps = fit_registration(
        matrix, model, modes=modes, modes_choice=modes_choice, solver=solver, loss=loss,
        learning_rate=learning_rate, start=start, max_iterations=max_iterations, covariance=covariance,
        priors=priors, usual_priors=usual_priors, update_priors=update_priors, coarse_search=coarse_search,
        extra_parameters=extra_parameters, actuator_model=actuator_model,
    )  # fmt: skip
    while True:
        try:
            next(steps)
        except StopIteration as done:
            fit: SprintFit = done.value
            return fit.estimate


def fit_registration(
    matrix: InteractionMatrix,
    model: SyntheticModel,
    *,
    modes: NDArray[np.intp] | int | None = None,
    modes_choice: ModesChoice = "snr",
    solver: Solver = "mixed-effects",
    loss: Loss = "squares",
    learning_rate: float = 1.0,
    start: Registration | None = None,
    max_iterations: int = 40,
    covariance: NDArray[np.float64] | None = None,
    priors: Priors | None = None,
    usual_priors: Priors = _USUAL_PRIORS,
    update_priors: bool = True,
    coarse_search: bool = True,
    extra_parameters: Sequence[ExtraParameter] = (),
    actuator_model: ActuatorModel = "fitted",
    state: MixedEffectsState | None = None,
    check_orientation: bool = True,
) -> Procedure[SprintFit]:
    """SPRINT as a procedure; parameters and errors as for :func:`sprint`.

    The mixed-effects fit starts at ``state``, that of an earlier fit with the same model and sub-apertures.
    Without ``check_orientation`` other orientations are not tried (:mod:`~.orientation`): an iteration that
    another one follows does not need them.
    """
    if not 0 < learning_rate <= 1:
        raise ValueError(f"learning_rate is {learning_rate}; it must lie in (0, 1]")
    solver = present_value("calibration.solver", solver)
    actuator_model = present_value("calibration.actuator_model", actuator_model)
    _require_one_of("solver", solver, SOLVERS)
    _require_one_of("modes_choice", modes_choice, MODES_CHOICES)
    _require_one_of("loss", loss, LOSSES)
    _require_one_of("actuator_model", actuator_model, ACTUATOR_MODELS)
    if extra_parameters and solver != "mixed-effects":
        raise ConfigError(
            f"calibration.solver = '{solver}' fits gain and registration alone; calibration.extra_parameters "
            "needs solver = 'mixed-effects'"
        )
    initial = start or Registration()
    notes: tuple[str, ...] = ()
    if is_tip_tilt_removed(matrix):
        model, notes = TipTiltFreeModel(model), (_TIP_TILT_NOTE,)
    with limit_to_one_thread():
        columns = _select_columns(matrix, model, modes, modes_choice, initial)
        _require_fittable(matrix, model, columns)
        weighted = apply_model_weights(WeightedMatrix.from_columns(matrix, columns), model)
    context = SolverContext(
        matrix, model, columns, solver, learning_rate, max_iterations, priors or usual_priors,
        build_extra_parameters(model, extra_parameters), usual_priors, check_orientation,
    )  # fmt: skip
    weighted, solution = yield from _in_one_thread(
        _solve_with_updates(context, weighted, initial.to_array(), coarse_search, update_priors, loss, state)
    )
    with limit_to_one_thread():
        estimate = _build_estimate(context, weighted, solution, covariance)
        estimate = replace(estimate, notes=(*notes, *estimate.notes))
        if actuator_model == "nominal":
            estimate = replace(estimate, actuator_corrections=None)
    yield context.progress(estimate.sigma)
    return SprintFit(estimate, solution.zonal_matrix, solution.estimate_priors, solution.state)


def estimate_registration(
    matrix: InteractionMatrix, model: SyntheticModel, **options: Any
) -> Procedure[RegistrationEstimate]:
    """The same for the estimate alone."""
    return (yield from fit_registration(matrix, model, **options)).estimate


def _in_one_thread(steps: Procedure[T]) -> Procedure[T]:
    """Advance a procedure with the linear-algebra libraries limited to one thread.

    The products of SPRINT are many and small. The limit does not hold while the procedure is suspended.
    """
    while True:
        try:
            with limit_to_one_thread():
                progress = next(steps)
        except StopIteration as done:
            result: T = done.value
            return result
        try:
            yield progress
        except BaseException:
            steps.close()
            raise


def _solve_with_updates(
    context: SolverContext,
    weighted: WeightedMatrix,
    start: NDArray[np.float64],
    coarse_search: bool,
    update_priors: bool,
    loss: Loss,
    state: MixedEffectsState | None,
) -> Procedure[tuple[WeightedMatrix, SprintSolution]]:
    """Solve, then again with noise, priors and outlier weights from the data; last weights and solution."""
    solution = None
    if state is None:
        # The scatters need no exact solution, and with usual ones there may be none nearby.
        solution = yield from solve(context, weighted, start, coarse_search, rough=update_priors)
        start, state = solution.alpha, solution.state
    if context.use_pokes(start) or solution is None:
        solution = yield from solve(context, weighted, start, False, state)
    if not weighted.has_standard_errors:
        # Twice, because with the noise overstated the effects take up too little of the matrix.
        for _ in range(2):
            weighted, context.problem = weighted.in_units_of(solution.system.residual), None
            solution = yield from solve(
                context, weighted, solution.alpha, False, solution.state, rough=update_priors
            )
    if update_priors and solution.estimate_priors is not None:
        context.priors = solution.estimate_priors().priors
        solution = yield from solve(context, weighted, solution.alpha, False, solution.state)
    without_huber = weighted
    for _ in range(HUBER_ITERATIONS if loss == "huber" else 0):
        fitted = without_huber.weigh(solution.zonal_matrix() @ without_huber.modes)
        weighted = without_huber.with_slope_weights(huber_weights(without_huber.data - fitted))
        solution = yield from solve(context, weighted, solution.alpha, False, solution.state)
    return weighted, solution


def _require_one_of(name: str, value: str, values: tuple[str, ...]) -> None:
    if value not in values:
        raise ValueError(f"{name} is {value!r}; it is one of {', '.join(values)}")


def _select_columns(
    matrix: InteractionMatrix,
    model: SyntheticModel,
    modes: NDArray[np.intp] | int | None,
    modes_choice: ModesChoice,
    start: Registration,
) -> NDArray[np.intp]:
    if modes is None:
        return np.arange(matrix.n_modes)
    if isinstance(modes, int):
        if modes < 1:
            raise ValueError(f"modes is {modes}; at least one is needed")
        if modes >= matrix.n_modes:
            return np.arange(matrix.n_modes)
        return choose_modes(matrix, modes, modes_choice, model, start)
    columns = np.asarray(modes, dtype=np.intp)
    if columns.size == 0 or columns.min() < 0 or columns.max() >= matrix.n_modes:
        raise ValueError(f"modes {modes!r} are not all in 0..{matrix.n_modes - 1}")
    return columns


def _require_fittable(matrix: InteractionMatrix, model: SyntheticModel, columns: NDArray[np.intp]) -> None:
    """Raise unless matrix and model belong together and the matrix has a signal."""
    if matrix.m2c.shape[0] != model.n_act:
        raise IncompatibleProduct(
            f"the matrix is for {matrix.m2c.shape[0]} actuators, the model has {model.n_act}"
        )
    rows = modal_matrix(model, Registration(), matrix.m2c[:, :1]).shape[0]
    if rows != matrix.n_slopes:
        raise IncompatibleProduct(
            f"the matrix has {matrix.n_slopes} slopes, the model {rows}; build the model on the matrix's grid"
        )
    for old, new in _RENAMED_CAPABILITIES.items():
        if hasattr(model, old) and not hasattr(model, new):
            warn_renamed(f"{old} of the model '{model.name}' is not used; since version 0.2.0 it is {new}")
    data, sigma = matrix.data[:, columns], matrix.sigma[:, columns]
    if not np.isfinite(data).all():
        raise CalibrationError("the interaction matrix is not finite; measure it again")
    if not data.any():
        raise CalibrationError("the interaction matrix is zero; does the sensor see the mirror?")
    for axis, half in zip("xy", np.split(data, 2), strict=True):
        if not half.any():
            raise CalibrationError(f"all {axis} slopes are zero; are they computed and in the matrix?")
    if not np.isfinite(sigma).all():
        raise CalibrationError("the interaction matrix's standard errors are not finite; measure it again")
    if (sigma > 0).all() and float(matrix.snr()[columns].max()) < _MIN_SNR:
        raise CalibrationError(
            "the interaction matrix holds nothing but noise; use more frames or larger pokes"
        )


def _build_estimate(
    context: SolverContext,
    weighted: WeightedMatrix,
    solution: SprintSolution,
    noise: NDArray[np.float64] | None,
) -> RegistrationEstimate:
    """Add standard errors, notes and warnings to a solution."""
    residual, excess = solution.system.residual, solution.excess_scatters
    covariance = sandwich_covariance(weighted, solution.system, noise, max([1.0, *excess.values()]))
    index = {name: k for k, name in enumerate(_PARAMETER_NAMES[: len(covariance)])}
    index.update({one.model.name: one.index for one in solution.extras})
    notes = describe_degeneracies(covariance[np.ix_([*index.values()], [*index.values()])], [*index])
    notes += describe_misfit(weighted, residual, excess)
    if solution.added_covariance is not None:
        covariance[1:6, 1:6] += solution.added_covariance
    model_sigma = systematic_error(context.model)
    covariance[np.arange(1, 6), np.arange(1, 6)] += np.square(model_sigma)
    clocking = None
    if isinstance(solution.system, NormalEquations):
        clocking = estimate_clocking(weighted, solution.system)
        covariance[1:6, 1:6] += clocking.covariance
    sigma = np.sqrt(np.diag(covariance))
    between_runs = repeatability_covariance(weighted, solution.system, noise, context.model)
    # Differences between runs are not less certain than the registration itself.
    share = np.minimum(1.0, sigma[1:6] / np.sqrt(np.diag(between_runs)))
    warnings = check_convergence(context, weighted, solution, sigma[1:6])
    registration = Registration.from_array(solution.alpha)
    if not warnings:
        notes += () if clocking is None else clocking.describe(sigma[1:6])
        notes += tuple(describe_description(weighted, residual, registration, solution.state))
    numbering = numbering_covariance(context.model)
    return RegistrationEstimate(
        registration,
        covariance[1:6, 1:6] + numbering,
        Estimate(solution.gain, float(sigma[GAIN])),
        Estimate(solution.width, float(sigma[WIDTH]) if sigma.size > WIDTH else 0.0),
        len(warnings) == 0,
        tuple(context.history),
        weighted.reduced_chi_squared(residual),
        warnings,
        (*describe_numbering(context.model, registration), *notes),
        extras={one.model.name: one.to_estimate(sigma, model_sigma) for one in solution.extras},
        **_fitted_mirror(context, solution, covariance),
        repeatability_covariance=between_runs * np.outer(share, share) + numbering,
        goodness_of_fit=assess_fit(weighted, residual, excess),
    )


def _fitted_mirror(
    context: SolverContext, solution: SprintSolution, covariance: NDArray[np.float64]
) -> dict[str, Any]:
    """Corrections of the actuators and profile of the influence functions, for solvers that fit them."""
    if solution.state is None or solution.actuator_corrections is None:
        return {}
    shape = solution.state.shape
    common = covariance[WIDTH : SHAPE + shape.size, WIDTH : SHAPE + shape.size].copy()
    return {
        "actuator_corrections": replace(solution.actuator_corrections(), shape_covariance=common),
        "influence_profile": estimate_profile(context.model, solution.width, shape, common),
    }


def check_convergence(
    context: SolverContext,
    weighted: WeightedMatrix,
    solution: SprintSolution,
    sigma: NDArray[np.float64],
) -> tuple[str, ...]:
    """Reasons not to use a solution; none if SPRINT has converged.

    It has converged when the steps became small, the model fits (:mod:`~.goodness_of_fit`), and the data
    constrain every parameter.

    Parameters
    ----------
    context, weighted, solution
        The problem and its solution.
    sigma
        Standard errors of the registration ``(5,)``.
    """
    registration = Registration.from_array(solution.alpha)
    warnings = check_fit(context.model, weighted, solution.system.residual, solution.gain, registration)
    # A large misfit of the model prevents steps as small as the noise alone would allow.
    steps_converged = solution.steps_converged or (
        solution.remaining_step is not None
        and bool((np.abs(solution.remaining_step) < _NEGLIGIBLE_STEP * sigma).all())
    )
    if not steps_converged:
        warnings.append(f"the steps did not shrink within {len(context.history)} iterations")
    worst = int(np.argmax(sigma / MAX_STEP))
    if sigma[worst] > MAX_STEP[worst]:
        warnings.append(f"the data do not constrain {PARAMETERS[worst]}; use more frames or more modes")
    if context.checks_orientation and (warnings or solution.excess_scatters):
        better = find_better_orientation(context.matrix, context.model, context.columns, solution.alpha)
        if better is not None:
            # All else that was found follows from it.
            return (better,)
    return tuple(warnings)
