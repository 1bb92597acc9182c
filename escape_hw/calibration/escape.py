"""ESCAPE: DO-CRIME, then SPRINT, then the pseudo-synthetic interaction matrix (the paper)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.model import SyntheticModel
from escape_hw.api.procedure import Procedure, Reporter
from escape_hw.api.results import CalibrationResult, RegistrationEstimate
from escape_hw.api.sensor import SubApertureGrid
from escape_hw.bench import Bench
from escape_hw.calibration.acquire import measured_matrix
from escape_hw.calibration.derivatives import modal_jacobian
from escape_hw.calibration.docrime import docrime_run
from escape_hw.calibration.sprint import sprint_steps
from escape_hw.errors import Aborted


def pseudo_synthetic(
    model: SyntheticModel, estimate: RegistrationEstimate, m2c: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The model's matrix at an estimated registration, and its standard errors.

    Parameters
    ----------
    model
        The synthetic model.
    estimate
        Result of SPRINT.
    m2c
        Modal basis ``(n_act, n_modes)``.

    Returns
    -------
    matrix, sigma : ndarray, ``(n_slopes, n_modes)``
        The errors are those of registration and gain, propagated to first order.
    """
    width, gain = estimate.width.value, estimate.gain.value
    unit, derivatives = modal_jacobian(model, estimate.registration, m2c, width)
    jacobian = gain * derivatives[:5]
    variance = np.einsum("psm,pq,qsm->sm", jacobian, estimate.covariance, jacobian, optimize=True)
    variance += np.square(unit * estimate.gain.sigma)
    return gain * unit, np.sqrt(np.maximum(variance, 0))


def synthesise(
    bench: Bench, grid: SubApertureGrid, estimate: RegistrationEstimate, m2c: NDArray[np.float64]
) -> CalibrationResult:
    """A calibration made of a registration alone, with nothing moved.

    Parameters
    ----------
    bench
        Gives the model.
    grid
        The sensor's grid.
    estimate
        The registration.
    m2c
        Modal basis ``(n_act, n_modes)``.
    """
    data, sigma = pseudo_synthetic(bench.model(grid), estimate, m2c)
    matrix = measured_matrix(bench, grid, m2c, data, sigma, "escape", gain=estimate.gain.value)
    return CalibrationResult(matrix, grid, 0, 0, 0.0, registration=estimate)


def escape(
    bench: Bench,
    *,
    frames: int | None = None,
    poke: float | None = None,
    grid: SubApertureGrid | None = None,
    whiten: bool = True,
) -> Procedure[CalibrationResult]:
    """Calibrate without a source: measure under turbulence, find the registration, synthesise.

    Parameters
    ----------
    bench, frames, poke, grid, whiten
        As for :func:`~escape_hw.calibration.docrime.docrime`.

    Returns
    -------
    CalibrationResult
        ``matrix`` is pseudo-synthetic, ``measured`` the DO-CRIME matrix behind it, ``registration``
        what SPRINT found; ``registration.converged`` says whether to trust it. Stopped early,
        ``matrix`` is the DO-CRIME matrix, ``partial`` is true and ``registration`` is ``None``.

    Raises
    ------
    TooFewFrames, CalibrationError, Aborted
        As for DO-CRIME.
    """
    run = yield from docrime_run(bench, frames=frames, poke=poke, grid=grid, whiten=whiten)
    measured, c = run.result, bench.config.calibration
    if measured.partial:
        return measured
    try:
        yield Reporter("synthetic model", 1, "model")(0)
        estimate = yield from sprint_steps(
            measured.matrix,
            bench.model(measured.grid),
            modes=min(c.sprint_modes, measured.matrix.n_modes),
            learning_rate=c.learning_rate,
            covariance=run.solution.covariance,
        )
    except Aborted:
        return replace(measured, partial=True)
    made = synthesise(bench, measured.grid, estimate, measured.matrix.m2c)
    metrics = {**measured.matrix.metrics, **made.matrix.metrics}
    # What errs for all of the measured matrix alike no fit to it can tell.
    gain = estimate.gain
    whole = float(np.hypot(gain.sigma, gain.value * run.solution.gain_sigma))
    return replace(
        measured,
        matrix=replace(made.matrix, metrics=metrics),
        registration=replace(estimate, gain=replace(gain, sigma=whole)),
        measured=measured.matrix,
        notes=(*measured.notes, *estimate.warnings),
    )
