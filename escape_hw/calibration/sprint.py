"""SPRINT: the registration of mirror and sensor from a measured interaction matrix.

Solves the paper's Eq. (argmin_simple), ``min over g, alpha of |D - g (D_0 + alpha Lambda)|``, by
damped Gauss-Newton with the learning rate of its update rule, the model linearised anew in every
iteration (Heritier et al. 2021). Beyond the paper it weights by the measured standard errors, and
fits what the synthetic model does not know as random effects (see :mod:`~.misfit`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.matrix import InteractionMatrix
from escape_hw.api.model import SyntheticModel
from escape_hw.api.procedure import Procedure, Reporter
from escape_hw.api.registration import PARAMETERS, Registration
from escape_hw.api.results import Measured, RegistrationEstimate, SprintIteration
from escape_hw.calibration.covariance import sandwich
from escape_hw.calibration.linearisation import GAIN, WIDTH, Problem, State
from escape_hw.calibration.misfit import NormalEquations, Priors
from escape_hw.errors import CalibrationError, IncompatibleProduct

#: Largest move in one iteration: the model is only locally linear.
_LARGEST = np.array([60.0, 60.0, 2.0, 4.0, 4.0])
#: A step below this many standard errors, or below the last column of the table, ends the descent.
_SMALL = np.array([5e-3, 5e-3, 2e-4, 2e-3, 2e-3])
#: Share of what noise leaves to explain that the model must explain to be believed.
_EXPLAINED = 0.8


def choose_modes(matrix: InteractionMatrix, n_modes: int) -> NDArray[np.intp]:
    """The ``n_modes`` modes with the highest signal-to-noise ratio, in their own order.

    On open-loop data these are not the first ones, which carry the turbulence.
    """
    snr = matrix.snr()
    best = np.argsort(np.where(np.isfinite(snr), -snr, -np.inf), kind="stable")[:n_modes]
    return np.sort(best)


def sprint(
    matrix: InteractionMatrix,
    model: SyntheticModel,
    *,
    modes: NDArray[np.intp] | int | None = None,
    learning_rate: float = 1.0,
    start: Registration | None = None,
    max_iterations: int = 25,
    covariance: NDArray[np.float64] | None = None,
    priors: Priors | None = None,
) -> RegistrationEstimate:
    """Registration, gain and their standard errors from an interaction matrix.

    Parameters
    ----------
    matrix
        The measured matrix; its standard errors are the weights.
    model
        The synthetic model, built on the same sub-apertures.
    modes
        Which columns to use, or how many of the best; all by default.
    learning_rate
        Share of each step that is taken, in (0, 1] (paper: gamma).
    start
        Where to start; zero by default.
    max_iterations
        Iterations before giving up.
    covariance
        Covariance of the slopes' noise ``(n_slopes, n_slopes)`` up to a factor, where it is known:
        turbulence moves neighbouring slopes together, and the error bars must know. Without it they
        learn of it from the scatter between modes, less precisely.
    priors
        Scatter of what the model does not know.

    Returns
    -------
    RegistrationEstimate
        ``converged`` is false when the steps did not shrink or when the model does not explain the
        matrix; ``warnings`` then says why.

    Raises
    ------
    IncompatibleProduct
        Matrix and model have different actuators or sub-apertures.
    CalibrationError
        The matrix holds no signal.
    ValueError
        A learning rate outside (0, 1].
    """
    steps = sprint_steps(
        matrix, model, modes=modes, learning_rate=learning_rate, start=start,
        max_iterations=max_iterations, covariance=covariance, priors=priors,
    )  # fmt: skip
    while True:
        try:
            next(steps)
        except StopIteration as done:
            estimate: RegistrationEstimate = done.value
            return estimate


def sprint_steps(
    matrix: InteractionMatrix,
    model: SyntheticModel,
    *,
    modes: NDArray[np.intp] | int | None = None,
    learning_rate: float = 1.0,
    start: Registration | None = None,
    max_iterations: int = 25,
    covariance: NDArray[np.float64] | None = None,
    priors: Priors | None = None,
) -> Procedure[RegistrationEstimate]:
    """As :func:`sprint`, iteration by iteration, so that it can be watched and stopped."""
    if not 0 < learning_rate <= 1:
        raise ValueError(f"learning_rate is {learning_rate}; it must lie in (0, 1]")
    columns = _columns(matrix, modes)
    _check_fit(matrix, model)
    if not np.isfinite(matrix.data[:, columns]).all():
        raise CalibrationError("the interaction matrix is not finite; measure it again")
    if not matrix.data[:, columns].any():
        raise CalibrationError("the interaction matrix is zero; does the sensor see the mirror?")
    problem = Problem(matrix, model, columns, priors or Priors())
    if not np.isfinite(problem.weighted.data).all():
        raise CalibrationError("the interaction matrix's standard errors are not finite; measure it again")
    if problem.weighted.measured and float(matrix.snr()[columns].max()) < 0.1:
        raise CalibrationError(
            "the interaction matrix holds nothing but noise; use more frames or larger pokes"
        )
    state = problem.start(start or Registration())
    history: list[SprintIteration] = []
    settled = False
    report = Reporter("SPRINT", max_iterations, "iteration")
    for _ in range(max_iterations):
        if progress := report.step():
            yield progress
        system = problem.linearise(state)
        step = system.solve()
        if not np.isfinite(step).all():
            break
        spread = np.sqrt(np.abs(np.diag(np.linalg.inv(system.information()))))[1:6]
        relative = np.abs(step[1:6]) / np.maximum(_SMALL, 0.02 * spread)
        history.append(_record(state, system, float(np.linalg.norm(step[1:6] / _LARGEST))))
        if relative.max() < 1.0:
            settled = True
            break
        damping = min(1.0, 1.0 / float(np.max(np.abs(step[1:6]) / _LARGEST)))
        state = problem.move(state, step * damping * learning_rate)
    system = problem.linearise(state)
    return _estimate(problem, matrix, state, system, history, settled, covariance)


def _columns(matrix: InteractionMatrix, modes: NDArray[np.intp] | int | None) -> NDArray[np.intp]:
    if modes is None:
        return np.arange(matrix.n_modes)
    if isinstance(modes, int):
        if modes < 1:
            raise ValueError(f"modes is {modes}; at least one is needed")
        return choose_modes(matrix, min(modes, matrix.n_modes))
    columns = np.asarray(modes, dtype=np.intp)
    if columns.size == 0 or columns.min() < 0 or columns.max() >= matrix.n_modes:
        raise ValueError(f"modes {modes!r} are not all in 0..{matrix.n_modes - 1}")
    return columns


def _check_fit(matrix: InteractionMatrix, model: SyntheticModel) -> None:
    if matrix.m2c.shape[0] != model.n_act:
        raise IncompatibleProduct(
            f"the matrix is for {matrix.m2c.shape[0]} actuators, the model has {model.n_act}"
        )
    rows = model.zonal_matrix(Registration()).shape[0]
    if rows != matrix.n_slopes:
        raise IncompatibleProduct(
            f"the matrix has {matrix.n_slopes} slopes, the model {rows}; build the model on the matrix's grid"
        )


def _record(state: State, system: NormalEquations, norm: float) -> SprintIteration:
    chi2 = float(np.mean(np.square(system.residual)))
    return SprintIteration(Registration.from_array(state.alpha), state.gain, norm, chi2)


def _estimate(
    problem: Problem,
    matrix: InteractionMatrix,
    state: State,
    system: NormalEquations,
    history: list[SprintIteration],
    settled: bool,
    noise: NDArray[np.float64] | None,
) -> RegistrationEstimate:
    chi2 = float(np.mean(np.square(system.residual)))
    covariance = sandwich(problem.weighted, system, noise)
    warnings = []
    if not settled:
        warnings.append(f"the steps did not shrink within {len(history)} iterations")
    model = problem.weighted.data - system.residual
    explained, explicable = problem.weighted.explained(system.residual), problem.weighted.explicable
    if explained < _EXPLAINED * explicable or np.vdot(model, problem.weighted.data) <= 0:
        warnings.append(
            f"the model explains {max(explained, 0.0):.0%} of the matrix "
            f"where noise leaves {explicable:.0%} "
            "to explain; wrong layout, flip or basis, or a registration beyond capture"
        )
    sigma = np.sqrt(np.diag(covariance))
    worst = int(np.argmax(sigma[1:6] / _LARGEST))
    if sigma[1 + worst] > _LARGEST[worst]:
        warnings.append(f"the data do not constrain {PARAMETERS[worst]}; use more frames or more modes")
    return RegistrationEstimate(
        Registration.from_array(state.alpha),
        covariance[1:6, 1:6],
        Measured(state.gain, float(sigma[GAIN])),
        Measured(1 + state.width, float(sigma[WIDTH])),
        settled and len(warnings) == 0,
        tuple(history),
        chi2,
        tuple(warnings),
    )
