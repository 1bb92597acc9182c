"""ESCAPE: DO-CRIME, then SPRINT, then the pseudo-synthetic interaction matrix (the paper)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from escape_hw.api.matrix import InteractionMatrix
from escape_hw.api.procedure import Procedure, Reporter
from escape_hw.api.results import CalibrationResult, RegistrationEstimate
from escape_hw.api.sensor import SensorGeometry
from escape_hw.bench import Bench
from escape_hw.calibration.checkpoint import Checkpoint
from escape_hw.calibration.docrime import docrime_run, least_frames, matrix_of
from escape_hw.calibration.docrime_closed import docrime_closed_run
from escape_hw.calibration.docrime_solution import DocrimeSolution
from escape_hw.calibration.escape_few import escape_from_few
from escape_hw.calibration.escape_few_closed import escape_closed_from_few
from escape_hw.calibration.pseudo_synthetic import synthesise
from escape_hw.calibration.sensor_setup import modal_basis
from escape_hw.calibration.solvers import BY_MODES
from escape_hw.calibration.sprint import sprint_steps
from escape_hw.calibration.sprint_settings import as_configured
from escape_hw.calibration.stopping import Target
from escape_hw.calibration.telemetry_sprint import independent_columns
from escape_hw.config.models import ESTIMATORS
from escape_hw.errors import Aborted, ConfigError


def escape(
    bench: Bench,
    *,
    frames: int | None = None,
    poke: float | None = None,
    grid: SensorGeometry | None = None,
    whiten: bool = True,
    estimator: str | None = None,
    closing: CalibrationResult | None = None,
    until: Target | None = None,
    keep: Checkpoint | None = None,
) -> Procedure[CalibrationResult]:
    """Calibrate without a source: measure under turbulence, find the registration, synthesise.

    Parameters
    ----------
    bench, frames, poke, grid, whiten
        As for :func:`~escape_hw.calibration.docrime.docrime`.
    estimator
        ``"matrix"``: SPRINT fits the DO-CRIME matrix, mode by mode, as the paper does.
        ``"telemetry"``: it fits what the whitened frames hold, which takes fewer frames than modes and
        loses nothing (see :mod:`~escape_hw.calibration.telemetry_sprint`). As configured by default;
        ``"auto"`` is the second.
    closing
        Measure in closed loop, with this calibration's matrix
        (:func:`~escape_hw.calibration.docrime_closed.docrime_closed_loop`).
    until
        Stop before that number of frames when this is reached.
    keep
        Where the state is kept meanwhile, and what to go on with.

    Returns
    -------
    CalibrationResult
        ``matrix`` is pseudo-synthetic, ``measured`` the DO-CRIME matrix behind it (``None`` if there
        were too few frames for one), ``registration`` what SPRINT found; ``registration.converged``
        says whether to trust it. Stopped early, ``matrix`` is the DO-CRIME matrix, ``partial`` is true
        and ``registration`` is ``None``.

    Raises
    ------
    ConfigError
        No such estimator, or the plain one in closed loop; nothing moved.
    TooFewFrames, CalibrationError, ProductError, Aborted
        As for DO-CRIME.
    """
    c = bench.config.calibration
    estimator = c.estimator if estimator is None else estimator
    if estimator not in ESTIMATORS:
        raise ConfigError(f"estimator '{estimator}' is unknown; it is one of {', '.join(ESTIMATORS)}")
    by_modes = c.solver in BY_MODES
    if by_modes and estimator == "telemetry":
        raise ConfigError(
            f"calibration.solver = '{c.solver}' fits modes, and telemetry has none; "
            "choose estimator = 'matrix' or another solver"
        )
    from_matrix = estimator == "matrix" or not whiten or by_modes
    n_frames = c.frames if frames is None else frames
    n_modes = bench.config.basis.n_modes if closing is None else closing.matrix.n_modes
    if whiten and not from_matrix and n_frames < least_frames(c, n_modes):
        if closing is not None:
            return (yield from escape_closed_from_few(bench, closing, frames=n_frames, poke=poke))
        return (yield from escape_from_few(bench, frames=n_frames, poke=poke, grid=grid))
    m2c = modal_basis(bench) if closing is None else closing.matrix.m2c

    def judge(solution: DocrimeSolution, grid: SensorGeometry) -> Procedure[bool]:
        matrix = matrix_of(bench, grid, m2c, solution, "escape")
        if until is None or not until.snr_met(matrix):
            return False
        if until.accuracy is None:
            return True
        found = yield from _fit(bench, matrix, grid, solution, from_matrix)
        return found.converged and float(found.sigma[:2].max()) <= until.accuracy

    asked = None if until is None else judge
    if closing is not None:
        if not whiten:
            raise ConfigError("the plain estimator is for open loop; in closed loop turbulence is whitened")
        run = yield from docrime_closed_run(bench, closing, frames=frames, poke=poke, keep=keep, judge=asked)
    else:
        run = yield from docrime_run(
            bench, frames=frames, poke=poke, grid=grid, whiten=whiten, keep=keep, judge=asked
        )
    measured, solution = run.result, run.solution
    if measured.partial:
        return measured
    try:
        estimate = yield from _fit(bench, measured.matrix, measured.grid, solution, from_matrix)
    except Aborted:
        return replace(measured, partial=True)
    made = synthesise(bench, measured.grid, estimate, measured.matrix.m2c)
    metrics = {**measured.matrix.metrics, **made.matrix.metrics}
    return replace(
        measured,
        matrix=replace(made.matrix, metrics=metrics),
        registration=_with_gain_error(estimate, solution.gain_sigma),
        measured=measured.matrix,
        notes=(*measured.notes, *estimate.warnings, *estimate.notes),
    )


def _fit(
    bench: Bench,
    matrix: InteractionMatrix,
    grid: SensorGeometry,
    solution: DocrimeSolution,
    from_matrix: bool,
) -> Procedure[RegistrationEstimate]:
    """SPRINT on a solution, mode by mode or with the whole covariance of its errors."""
    c = bench.config.calibration
    modes = min(c.sprint_modes, matrix.n_modes)
    if not from_matrix:
        matrix = independent_columns(matrix, solution.gram, solution.variance)
        modes = matrix.n_modes
    yield Reporter("synthetic model", 1, "model")(0)
    return (
        yield from sprint_steps(
            matrix,
            bench.model(grid),
            modes=modes,
            covariance=solution.covariance,
            learn=True,
            **as_configured(c),
        )
    )


def _with_gain_error(estimate: RegistrationEstimate, relative: float) -> RegistrationEstimate:
    """The estimate with the error that all modes share, which no fit to a matrix can tell."""
    gain = estimate.gain
    return replace(estimate, gain=replace(gain, sigma=float(np.hypot(gain.sigma, gain.value * relative))))
