"""SPRINT: the registration of mirror and sensor from a measured interaction matrix.

Solves the paper's Eq. (argmin_simple), ``min over g, alpha of |D - g (D_0 + alpha Lambda)|``, by
damped Gauss-Newton with the learning rate of its update rule, the model linearised anew in every
iteration (Heritier et al. 2021). Beyond the paper it weights by the measured standard errors, and
fits what the synthetic model does not know as random effects (see :mod:`~.misfit`).
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.matrix import InteractionMatrix
from escape_hw.api.model import SyntheticModel
from escape_hw.api.procedure import Procedure, Reporter
from escape_hw.api.registration import PARAMETERS, Registration
from escape_hw.api.results import Measured, RegistrationEstimate, SprintIteration
from escape_hw.api.threads import hold_to_one_thread
from escape_hw.calibration.capture import EXPLAINED, capture
from escape_hw.calibration.covariance import Linearised, sandwich
from escape_hw.calibration.derivatives import modal_matrix
from escape_hw.calibration.light import SMALL, LightFit, LightProblem
from escape_hw.calibration.linearisation import GAIN, WIDTH, Problem
from escape_hw.calibration.misfit import Priors
from escape_hw.calibration.parity import parity_hint
from escape_hw.calibration.weighted import WeightedMatrix
from escape_hw.errors import CalibrationError, IncompatibleProduct

#: Largest move in one iteration: the model is only locally linear.
_LARGEST = np.array([60.0, 60.0, 2.0, 4.0, 4.0])


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
    misfit: bool = True,
    reach: bool = True,
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
    misfit
        Whether to fit that too. Without it gain and registration are the only unknowns: several times
        faster and as good on a mirror that is like its model; on a real one less accurate, and its
        error bars know nothing of unequal actuators.
    reach
        Whether to come from afar first, low modes before high ones (:mod:`~.capture`). Without it the
        descent is from ``start`` alone, on all modes at once.

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
        max_iterations=max_iterations, covariance=covariance, priors=priors, misfit=misfit, reach=reach,
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
    misfit: bool = True,
    reach: bool = True,
) -> Procedure[RegistrationEstimate]:
    """As :func:`sprint`, iteration by iteration, so that it can be watched and stopped."""
    # The products are many and small.
    with hold_to_one_thread():
        return (yield from _steps(
            matrix, model, modes, learning_rate, start, max_iterations, covariance, priors, misfit, reach
        ))  # fmt: skip


def _steps(
    matrix: InteractionMatrix,
    model: SyntheticModel,
    modes: NDArray[np.intp] | int | None,
    learning_rate: float,
    start: Registration | None,
    max_iterations: int,
    covariance: NDArray[np.float64] | None,
    priors: Priors | None,
    misfit: bool,
    reach: bool,
) -> Procedure[RegistrationEstimate]:
    if not 0 < learning_rate <= 1:
        raise ValueError(f"learning_rate is {learning_rate}; it must lie in (0, 1]")
    columns = _columns(matrix, modes)
    _check(matrix, model, columns)
    report = Reporter("SPRINT", max_iterations, "iteration")
    history: list[SprintIteration] = []
    weighted = WeightedMatrix.of(matrix, columns)
    begin = (start or Registration()).to_array()
    if reach or not misfit:
        if reach:
            steps = capture(matrix, model, columns, begin, max_iterations, learning_rate)
        else:
            steps = LightProblem(weighted, model, learning_rate).descend(begin, max_iterations)
        light = yield from _watched(steps, report, history)
        begin = light.alpha
    if misfit:
        found = yield from _with_misfit(
            Problem(weighted, model, priors or Priors()),
            Registration.from_array(begin), max_iterations, learning_rate, report, history,
        )  # fmt: skip
    else:
        found = _Solution(light, light.alpha, light.gain, 1.0, light.settled)
    return _estimate(matrix, model, columns, weighted, found, tuple(history), covariance)


def _watched(
    steps: Generator[LightFit, None, LightFit], report: Reporter, history: list[SprintIteration]
) -> Procedure[LightFit]:
    """Hand on the progress of a descent and keep its steps."""
    while True:
        try:
            fit = next(steps)
        except StopIteration as done:
            light: LightFit = done.value
            return light
        norm = float(np.linalg.norm(fit.step / _LARGEST))
        history.append(_record(fit.alpha, fit.gain, fit.residual, norm))
        if progress := report.step():
            yield progress


def _with_misfit(
    problem: Problem,
    start: Registration,
    max_iterations: int,
    learning_rate: float,
    report: Reporter,
    history: list[SprintIteration],
) -> Procedure[_Solution]:
    """Gauss-Newton on registration and random effects together."""
    state, settled = problem.start(start), False
    system = problem.linearise(state)
    for _ in range(max_iterations):
        if progress := report.step():
            yield progress
        step = system.solve()
        if not np.isfinite(step).all():
            break
        spread = np.sqrt(np.abs(np.diag(np.linalg.inv(system.information()))))[1:6]
        spread *= problem.weighted.noise(system.residual)
        relative = np.abs(step[1:6]) / np.maximum(SMALL, 0.02 * spread)
        norm = float(np.linalg.norm(step[1:6] / _LARGEST))
        history.append(_record(state.alpha, state.gain, system.residual, norm))
        if relative.max() < 1.0:
            settled = True
            break
        damping = min(1.0, 1.0 / float(np.max(np.abs(step[1:6]) / _LARGEST)))
        state = problem.move(state, step * damping * learning_rate)
        system = problem.linearise(state)
    return _Solution(system, state.alpha, state.gain, 1 + state.width, settled)


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


def _record(
    alpha: NDArray[np.float64], gain: float, residual: NDArray[np.float64], norm: float
) -> SprintIteration:
    chi2 = float(np.mean(np.square(residual)))
    return SprintIteration(Registration.from_array(alpha), gain, norm, chi2)


@dataclass(frozen=True, slots=True)
class _Solution:
    """Where a descent ended, with and without random effects alike."""

    system: Linearised
    alpha: NDArray[np.float64]
    gain: float
    width: float
    settled: bool


def _estimate(
    matrix: InteractionMatrix,
    model: SyntheticModel,
    columns: NDArray[np.intp],
    weighted: WeightedMatrix,
    found: _Solution,
    history: tuple[SprintIteration, ...],
    noise: NDArray[np.float64] | None,
) -> RegistrationEstimate:
    residual = found.system.residual
    covariance = sandwich(weighted, found.system, noise)
    warnings = []
    if not found.settled:
        warnings.append(f"the steps did not shrink within {len(history)} iterations")
    explained, explicable = weighted.explained(residual), weighted.explicable
    if explained < EXPLAINED * explicable or np.vdot(weighted.data - residual, weighted.data) <= 0:
        hint = parity_hint(matrix, model, columns)
        warnings.append(
            f"the model explains {max(explained, 0.0):.0%} of the matrix where noise leaves {explicable:.0%} "
            f"to explain; {hint or 'wrong layout, flip or basis, or a registration beyond capture'}"
        )
    elif found.gain < 0:
        warnings.append(
            "the gain is negative: the mirror pulls where the model pushes; check its polarity, "
            "or whether the camera is turned by 180 degrees"
        )
    sigma = np.sqrt(np.diag(covariance))
    worst = int(np.argmax(sigma[1:6] / _LARGEST))
    if sigma[1 + worst] > _LARGEST[worst]:
        warnings.append(f"the data do not constrain {PARAMETERS[worst]}; use more frames or more modes")
    width = float(sigma[WIDTH]) if sigma.size > WIDTH else 0.0
    return RegistrationEstimate(
        Registration.from_array(found.alpha),
        covariance[1:6, 1:6],
        Measured(found.gain, float(sigma[GAIN])),
        Measured(found.width, width),
        found.settled and len(warnings) == 0,
        history,
        float(np.mean(np.square(residual))),
        tuple(warnings),
    )
