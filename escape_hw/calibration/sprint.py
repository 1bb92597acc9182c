"""SPRINT: the registration of mirror and sensor from a measured interaction matrix.

Solves the paper's Eq. (argmin_simple), ``min over g, alpha of |D - g (D_0 + alpha Lambda)|``, by
damped Gauss-Newton with the learning rate of its update rule, the model linearised anew in every
iteration (Heritier et al. 2021). Beyond the paper it weights by the measured standard errors, and
fits what the synthetic model does not know as random effects (see :mod:`~.misfit`). The paper's
batches, the original's gain for every mode and other variants can be had instead (:mod:`~.solvers`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import ParamSpec

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.matrix import InteractionMatrix
from escape_hw.api.model import DoubtfulModel, SyntheticModel
from escape_hw.api.procedure import Procedure
from escape_hw.api.registration import PARAMETERS, Registration
from escape_hw.api.results import Measured, RegistrationEstimate
from escape_hw.api.threads import hold_to_one_thread
from escape_hw.calibration.capture import EXPLAINED
from escape_hw.calibration.covariance import FLOOR, sandwich
from escape_hw.calibration.degeneracy import degeneracies
from escape_hw.calibration.derivatives import modal_matrix
from escape_hw.calibration.extra_unknowns import extra_unknowns
from escape_hw.calibration.linearisation import GAIN, WIDTH, Learned
from escape_hw.calibration.misfit import Priors
from escape_hw.calibration.mode_choice import choose_modes
from escape_hw.calibration.parity import parity_hint
from escape_hw.calibration.robust import ROUNDS, as_trusted, trust
from escape_hw.calibration.solvers import LARGEST, Descent, Solution, solve
from escape_hw.calibration.weighted import WeightedMatrix
from escape_hw.config.models import (
    ACTUATORS,
    LOSSES,
    MODES_CHOICES,
    SOLVERS,
    Actuators,
    Extra,
    Loss,
    ModesChoice,
    Solver,
)
from escape_hw.errors import CalibrationError, ConfigError, IncompatibleProduct

P = ParamSpec("P")

#: The common parameters, in their order; variants of the model come after them.
_NAMES = ("gain", *PARAMETERS, "width", "pedestal")
#: A step that is left does not matter below this share of the stated errors.
_NO_MATTER = 0.05


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
    zonal: Callable[[], NDArray[np.float64]]
    learned: Callable[[], Learned] | None = None


def fit_steps(
    matrix: InteractionMatrix,
    model: SyntheticModel,
    *,
    modes: NDArray[np.intp] | int | None = None,
    choice: ModesChoice = "snr",
    solver: Solver = "effects",
    loss: Loss = "squares",
    learning_rate: float = 1.0,
    start: Registration | None = None,
    max_iterations: int = 25,
    covariance: NDArray[np.float64] | None = None,
    priors: Priors | None = None,
    learn: bool = False,
    reach: bool = True,
    also: Sequence[Extra] = (),
    actuators: Actuators = "found",
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
        ``"effects"``: with all that the model does not know as random effects. ``"light"``: gain and
        registration are the only unknowns; several times faster and as good on a mirror that is like its
        model, less accurate on a real one, and its error bars know nothing of unequal actuators.
        ``"frozen"``: the same with the derivatives of the start. ``"batches"``: the paper's, a few modes at
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
        What to fit beside the registration (:mod:`~.extra_unknowns`), by the solver ``"effects"``.
    actuators
        ``"found"``: the estimate keeps what was found of every actuator, and a matrix made from it has it,
        too. ``"alike"``: it does not, and the matrix is that of the model's actuators. The fit is the same.

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
    _known("solver", solver, SOLVERS)
    _known("choice", choice, MODES_CHOICES)
    _known("loss", loss, LOSSES)
    if also and solver != "effects":
        raise ConfigError(
            f"calibration.solver = '{solver}' fits gain and registration alone; what calibration.also "
            "asks for takes solver = 'effects'"
        )
    _known("actuators", actuators, ACTUATORS)
    begin = start or Registration()
    # The products are many and small.
    with hold_to_one_thread():
        columns = _columns(matrix, model, modes, choice, begin)
        _check(matrix, model, columns)
        extras = extra_unknowns(model, also)
        descent = Descent(
            matrix, model, columns, solver, learning_rate, max_iterations, priors or Priors(), extras
        )
        weighted = as_trusted(WeightedMatrix.of(matrix, columns), model)
        found = yield from solve(descent, weighted, begin.to_array(), reach)
        if learn and found.learned is not None:
            descent.priors = found.learned().priors
            found = yield from solve(descent, weighted, found.alpha, False)
        whole = weighted
        for _ in range(ROUNDS if loss == "huber" else 0):
            shares = trust(whole.data - _in_errors(whole, found))
            weighted = whole.trusting(shares)
            found = yield from solve(descent, weighted, found.alpha, False)
        estimate = _estimate(descent, weighted, found, covariance)
        if actuators == "found" and found.departures is not None:
            estimate = replace(estimate, departures=found.departures())
    yield descent.progress(estimate.sigma)
    return SprintFit(estimate, found.zonal, found.learned)


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

    to_the_end.__doc__ = fit_steps.__doc__
    return to_the_end


#: As :func:`fit_steps`, for the estimate alone.
sprint_steps = _only_estimate(fit_steps)
#: The same in one go.
sprint = _to_the_end(sprint_steps)


def _known(name: str, value: str, values: tuple[str, ...]) -> None:
    if value not in values:
        raise ValueError(f"{name} is {value!r}; it is one of {', '.join(values)}")


def _in_errors(weighted: WeightedMatrix, found: Solution) -> NDArray[np.float64]:
    """The matrix that was found, in standard errors ``(n_slopes, n_modes)``."""
    return weighted.weigh(found.zonal() @ weighted.modes)


def _columns(
    matrix: InteractionMatrix,
    model: SyntheticModel,
    modes: NDArray[np.intp] | int | None,
    choice: ModesChoice,
    start: Registration,
) -> NDArray[np.intp]:
    if modes is None:
        return np.arange(matrix.n_modes)
    if isinstance(modes, int):
        if modes < 1:
            raise ValueError(f"modes is {modes}; at least one is needed")
        if modes >= matrix.n_modes:
            return np.arange(matrix.n_modes)
        return choose_modes(matrix, modes, choice, model, start)
    columns = np.asarray(modes, dtype=np.intp)
    if columns.size == 0 or columns.min() < 0 or columns.max() >= matrix.n_modes:
        raise ValueError(f"modes {modes!r} are not all in 0..{matrix.n_modes - 1}")
    return columns


def _check(matrix: InteractionMatrix, model: SyntheticModel, columns: NDArray[np.intp]) -> None:
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


def _estimate(
    descent: Descent, weighted: WeightedMatrix, found: Solution, noise: NDArray[np.float64] | None
) -> RegistrationEstimate:
    model, history = descent.model, tuple(descent.history)
    residual = found.system.residual
    covariance = sandwich(weighted, found.system, noise)
    named = {name: k for k, name in enumerate(_NAMES[: len(covariance)])}
    named.update({one.unknown.name: one.place for one in found.extras})
    notes = degeneracies(covariance[np.ix_([*named.values()], [*named.values()])], [*named])
    if found.scatter is not None:
        covariance[1:6, 1:6] += found.scatter
    doubt = model.registration_doubt if isinstance(model, DoubtfulModel) else np.zeros(5)
    covariance[np.arange(1, 6), np.arange(1, 6)] += np.square(doubt)
    sigma = np.sqrt(np.diag(covariance))
    warnings = []
    # Where the model misses much, steps as small as noise would have them never come.
    settled = found.settled or (
        found.left is not None and bool((np.abs(found.left) < _NO_MATTER * sigma[1:6]).all())
    )
    if not settled:
        warnings.append(f"the steps did not shrink within {len(history)} iterations")
    explained, explicable = weighted.explained(residual), weighted.explicable
    if explained < EXPLAINED * explicable or np.vdot(weighted.data - residual, weighted.data) <= 0:
        hint = parity_hint(descent.matrix, model, descent.columns)
        warnings.append(
            f"the model explains {max(explained, 0.0):.0%} of the matrix where noise leaves {explicable:.0%} "
            f"to explain; {hint or 'wrong layout, flip or basis, or a registration beyond capture'}"
        )
    elif found.gain < 0:
        warnings.append(
            "the gain is negative: the mirror pulls where the model pushes; check its polarity, "
            "or whether the camera is turned by 180 degrees"
        )
    worst = int(np.argmax(sigma[1:6] / LARGEST))
    if sigma[1 + worst] > LARGEST[worst]:
        warnings.append(f"the data do not constrain {PARAMETERS[worst]}; use more frames or more modes")
    width = float(sigma[WIDTH]) if sigma.size > WIDTH else 0.0
    return RegistrationEstimate(
        Registration.from_array(found.alpha),
        covariance[1:6, 1:6],
        Measured(found.gain, float(sigma[GAIN])),
        Measured(found.width, width),
        len(warnings) == 0,
        history,
        float(np.mean(np.square(residual))),
        tuple(warnings),
        notes,
        extras={one.unknown.name: one.measured(sigma, np.hypot(FLOOR, doubt)) for one in found.extras},
    )
