"""SPRINT: registration of mirror and sensor from a measured interaction matrix, with standard errors, warnings and the convergence decision."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import ParamSpec, TypedDict

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.concurrency import limit_to_one_thread
from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.procedure import Procedure
from escape_hw.api.registration import PARAMETERS, Registration
from escape_hw.api.results import Estimate, RegistrationEstimate
from escape_hw.api.synthetic_model import HasSystematicError, SyntheticModel
from escape_hw.calibration.modes.derivatives import modal_matrix
from escape_hw.calibration.sprint.coarse_search import MIN_EXPLAINED_FRACTION
from escape_hw.calibration.sprint.covariance import MODEL_ERROR_FLOOR, sandwich_covariance
from escape_hw.calibration.sprint.diagnostics import check_orientation, describe_degeneracies
from escape_hw.calibration.sprint.extra_parameters import build_extra_parameters
from escape_hw.calibration.sprint.mixed_effects import GAIN, WIDTH, PriorEstimate
from escape_hw.calibration.sprint.mode_choice import choose_modes
from escape_hw.calibration.sprint.normal_equations import Priors
from escape_hw.calibration.sprint.slope_weights import HUBER_ITERATIONS, apply_model_weights, huber_weights
from escape_hw.calibration.sprint.solvers import MAX_STEP, SolverContext, SprintSolution, solve
from escape_hw.calibration.sprint.weighted_matrix import WeightedMatrix
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
from escape_hw.errors import CalibrationError, ConfigError, IncompatibleProduct


class SprintOptions(TypedDict):
    """Options of :func:`~escape_hw.calibration.sprint.fit.sprint`."""

    modes_choice: ModesChoice
    solver: Solver
    loss: Loss
    actuators: ActuatorModel
    learning_rate: float
    also: tuple[ExtraParameter, ...]


def sprint_options_from_config(section: CalibrationSection) -> SprintOptions:
    """Options of SPRINT as a system's configuration has them."""
    return {
        "modes_choice": section.modes_choice,
        "solver": section.solver,
        "loss": section.loss,
        "actuators": section.actuator_model,
        "learning_rate": section.learning_rate,
        "also": section.extra_parameters,
    }


P = ParamSpec("P")

#: The common parameters, in their order; variants of the model come after them.
_PARAMETER_NAMES = ("gain", *PARAMETERS, "width", "pedestal")
#: A step that is left does not matter below this share of the stated errors.
_NEGLIGIBLE_STEP = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class SprintFit:
    """A solution with the matrix that it stands for.

    Parameters
    ----------
    estimate
        Registration and gain, with errors.
    zonal
        Gives slopes per unit command ``(n_slopes, n_act)`` with all that was fitted, random effects
        included: of the mirror at hand rather than of the one of the drawing.
    learned
        Gives what the data say about the scatter of the random effects; ``None`` for a solver without.
    """

    estimate: RegistrationEstimate
    zonal_matrix: Callable[[], NDArray[np.float64]]
    estimate_priors: Callable[[], PriorEstimate] | None = None


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
    max_iterations: int = 25,
    covariance: NDArray[np.float64] | None = None,
    priors: Priors | None = None,
    update_priors: bool = False,
    coarse_search: bool = True,
    also: Sequence[ExtraParameter] = (),
    actuators: ActuatorModel = "fitted",
) -> Procedure[SprintFit]:
    """Registration, gain and their standard errors from an interaction matrix.

    Parameters
    ----------
    matrix
        The measured matrix; its standard errors are the weights.
    model
        The synthetic model, built on the same sub-apertures.
    modes
        Which columns to use, or how many of the best; all by default.
    choice
        Which are the best, see :func:`~.mode_choice.choose_modes`.
    solver
        ``"mixed-effects"``: with all that the model does not know as random effects. ``"registration-only"``: gain and
        registration are the only unknowns; several times faster and as good on a mirror that is like its
        model, less accurate on a real one, and its error bars know nothing of unequal actuators.
        ``"frozen-derivatives"``: the same with the derivatives of the start. ``"batches"``: the paper's, a few modes at
        a time (:mod:`~.batches`). ``"diagonal"``: the original's gain for every mode (:mod:`~.diagonal`).
    loss
        ``"squares"``, or ``"huber"``: sub-apertures that do not fit in with the others count less
        (:mod:`~.robust`).
    learning_rate
        Share of each step that is taken, in (0, 1] (paper: gamma).
    start
        Where to start; zero by default.
    max_iterations
        Iterations before giving up; rounds of the batches.
    covariance
        Covariance of the slopes' noise ``(n_slopes, n_slopes)`` up to a factor, where it is known:
        turbulence moves neighbouring slopes together, and the error bars must know. Without it they
        learn of it from the scatter between modes, less precisely.
    priors
        Scatter of what the model does not know.
    learn
        Whether to take that scatter from the data and to solve once more with it, which is worth while
        with few frames.
    reach
        Whether to come from afar first, low modes before high ones (:mod:`~.capture`). Without it the
        descent is from ``start`` alone, on all modes at once.
    also
        What to fit beside the registration (:mod:`~.build_extra_parameters`), by the solver ``"mixed-effects"``.
    actuators
        ``"fitted"``: the estimate keeps what was found of every actuator, and a matrix made from it has it,
        too. ``"nominal"``: it does not, and the matrix is that of the model's actuators. The fit is the same.

    Returns
    -------
    SprintFit
        Its estimate's ``converged`` is false when the steps did not shrink or when the model does not
        explain the matrix; ``warnings`` then says why.

    Raises
    ------
    IncompatibleProduct
        Matrix and model have different actuators or sub-apertures.
    CalibrationError
        The matrix holds no signal.
    ConfigError
        The model does not know what is asked for in ``also``.
    ValueError
        A learning rate outside (0, 1]; no such solver, choice, loss or actuators.
    """
    if not 0 < learning_rate <= 1:
        raise ValueError(f"learning_rate is {learning_rate}; it must lie in (0, 1]")
    solver = present_value("calibration.solver", solver)
    actuators = present_value("calibration.actuator_model", actuators)
    _require_one_of("solver", solver, SOLVERS)
    _require_one_of("choice", modes_choice, MODES_CHOICES)
    _require_one_of("loss", loss, LOSSES)
    if also and solver != "mixed-effects":
        raise ConfigError(
            f"calibration.solver = '{solver}' fits gain and registration alone; what calibration.extra_parameters "
            "asks for takes solver = 'mixed-effects'"
        )
    _require_one_of("actuators", actuators, ACTUATOR_MODELS)
    initial = start or Registration()
    # The products are many and small.
    with limit_to_one_thread():
        columns = _select_columns(matrix, model, modes, modes_choice, initial)
        _require_fittable(matrix, model, columns)
        extras = build_extra_parameters(model, also)
        context = SolverContext(
            matrix, model, columns, solver, learning_rate, max_iterations, priors or Priors(), extras
        )
        weighted = apply_model_weights(WeightedMatrix.of(matrix, columns), model)
        solution = yield from solve(context, weighted, initial.to_array(), coarse_search)
        if update_priors and solution.estimate_priors is not None:
            context.priors = solution.estimate_priors().priors
            solution = yield from solve(context, weighted, solution.alpha, False)
        without_huber = weighted
        for _ in range(HUBER_ITERATIONS if loss == "huber" else 0):
            robust_weights = huber_weights(
                without_huber.data - _fitted_in_standard_errors(without_huber, solution)
            )
            weighted = without_huber.with_slope_weights(robust_weights)
            solution = yield from solve(context, weighted, solution.alpha, False)
        estimate = _build_estimate(context, weighted, solution, covariance)
        if actuators == "fitted" and solution.actuator_corrections is not None:
            estimate = replace(estimate, actuator_corrections=solution.actuator_corrections())
    yield context.progress(estimate.sigma)
    return SprintFit(estimate, solution.zonal_matrix, solution.estimate_priors)


def _only_estimate(steps: Callable[P, Procedure[SprintFit]]) -> Callable[P, Procedure[RegistrationEstimate]]:
    def estimate_steps(*args: P.args, **options: P.kwargs) -> Procedure[RegistrationEstimate]:
        return (yield from steps(*args, **options)).estimate

    return estimate_steps


def _to_the_end(
    steps: Callable[P, Procedure[RegistrationEstimate]],
) -> Callable[P, RegistrationEstimate]:
    def to_the_end(*args: P.args, **options: P.kwargs) -> RegistrationEstimate:
        running = steps(*args, **options)
        while True:
            try:
                next(running)
            except StopIteration as done:
                estimate: RegistrationEstimate = done.value
                return estimate

    to_the_end.__doc__ = fit_registration.__doc__
    return to_the_end


#: As :func:`fit_registration`, for the estimate alone.
estimate_registration = _only_estimate(fit_registration)
#: The same in one go.
sprint = _to_the_end(estimate_registration)


def _require_one_of(name: str, value: str, values: tuple[str, ...]) -> None:
    if value not in values:
        raise ValueError(f"{name} is {value!r}; it is one of {', '.join(values)}")


def _fitted_in_standard_errors(weighted: WeightedMatrix, solution: SprintSolution) -> NDArray[np.float64]:
    """The matrix that was found, in standard errors ``(n_slopes, n_modes)``."""
    return weighted.weigh(solution.zonal_matrix() @ weighted.modes)


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
    """Refuse what cannot be fitted, with the reason."""
    if matrix.m2c.shape[0] != model.n_act:
        raise IncompatibleProduct(
            f"the matrix is for {matrix.m2c.shape[0]} actuators, the model has {model.n_act}"
        )
    rows = modal_matrix(model, Registration(), matrix.m2c[:, :1]).shape[0]
    if rows != matrix.n_slopes:
        raise IncompatibleProduct(
            f"the matrix has {matrix.n_slopes} slopes, the model {rows}; build the model on the matrix's grid"
        )
    data, sigma = matrix.data[:, columns], matrix.sigma[:, columns]
    if not np.isfinite(data).all():
        raise CalibrationError("the interaction matrix is not finite; measure it again")
    if not data.any():
        raise CalibrationError("the interaction matrix is zero; does the sensor see the mirror?")
    if not np.isfinite(sigma).all():
        raise CalibrationError("the interaction matrix's standard errors are not finite; measure it again")
    if (sigma > 0).all() and float(matrix.snr()[columns].max()) < 0.1:
        raise CalibrationError(
            "the interaction matrix holds nothing but noise; use more frames or larger pokes"
        )


def _build_estimate(
    context: SolverContext,
    weighted: WeightedMatrix,
    solution: SprintSolution,
    noise: NDArray[np.float64] | None,
) -> RegistrationEstimate:
    model, history = context.model, tuple(context.history)
    residual = solution.system.residual
    covariance = sandwich_covariance(weighted, solution.system, noise)
    parameter_index = {name: k for k, name in enumerate(_PARAMETER_NAMES[: len(covariance)])}
    parameter_index.update({one.unknown.name: one.index for one in solution.extras})
    notes = describe_degeneracies(
        covariance[np.ix_([*parameter_index.values()], [*parameter_index.values()])], [*parameter_index]
    )
    if solution.added_covariance is not None:
        covariance[1:6, 1:6] += solution.added_covariance
    systematic_error = (
        model.registration_systematic_error if isinstance(model, HasSystematicError) else np.zeros(5)
    )
    covariance[np.arange(1, 6), np.arange(1, 6)] += np.square(systematic_error)
    sigma = np.sqrt(np.diag(covariance))
    warnings = []
    # Where the model misses much, steps as small as noise would have them never come.
    steps_converged = solution.steps_converged or (
        solution.remaining_step is not None
        and bool((np.abs(solution.remaining_step) < _NEGLIGIBLE_STEP * sigma[1:6]).all())
    )
    if not steps_converged:
        warnings.append(f"the steps did not shrink within {len(history)} iterations")
    explained_fraction, signal_fraction = weighted.explained_fraction(residual), weighted.signal_fraction
    if (
        explained_fraction < MIN_EXPLAINED_FRACTION * signal_fraction
        or np.vdot(weighted.data - residual, weighted.data) <= 0
    ):
        hint = check_orientation(context.matrix, model, context.columns)
        warnings.append(
            f"the model explains {max(explained_fraction, 0.0):.0%} of the matrix where noise leaves {signal_fraction:.0%} "
            f"to explain; {hint or 'wrong layout, flip or basis, or a registration beyond capture'}"
        )
    elif solution.gain < 0:
        warnings.append(
            "the gain is negative: the mirror pulls where the model pushes; check its polarity, "
            "or whether the camera is turned by 180 degrees"
        )
    worst = int(np.argmax(sigma[1:6] / MAX_STEP))
    if sigma[1 + worst] > MAX_STEP[worst]:
        warnings.append(f"the data do not constrain {PARAMETERS[worst]}; use more frames or more modes")
    width = float(sigma[WIDTH]) if sigma.size > WIDTH else 0.0
    return RegistrationEstimate(
        Registration.from_array(solution.alpha),
        covariance[1:6, 1:6],
        Estimate(solution.gain, float(sigma[GAIN])),
        Estimate(solution.width, width),
        len(warnings) == 0,
        history,
        float(np.mean(np.square(residual))),
        tuple(warnings),
        notes,
        extras={
            one.unknown.name: one.to_estimate(sigma, np.hypot(MODEL_ERROR_FLOOR, systematic_error))
            for one in solution.extras
        },
    )
