"""ESCAPE: DO-CRIME, then SPRINT, then the pseudo-synthetic interaction matrix (the paper)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.procedure import Procedure, Reporter
from escape_hw.api.results import CalibrationResult, RegistrationEstimate
from escape_hw.api.sensor import SensorGeometry
from escape_hw.bench import Bench
from escape_hw.calibration.acquisition.checkpoint import Checkpoint
from escape_hw.calibration.acquisition.stopping import Target
from escape_hw.calibration.docrime.closed_loop import docrime_closed_run
from escape_hw.calibration.docrime.fit import DocrimeSolution
from escape_hw.calibration.docrime.open_loop import build_solution_matrix, docrime_run, minimum_frames
from escape_hw.calibration.escape.short_runs import (
    calibrate_short_run,
    calibrate_short_run_closed_loop,
    fit_recorded_frames,
)
from escape_hw.calibration.modes.bases import build_modal_basis
from escape_hw.calibration.sprint.fit import estimate_registration, sprint_options_from_config
from escape_hw.calibration.sprint.solvers import MATRIX_ONLY_SOLVERS
from escape_hw.calibration.sprint.synthetic_matrix import synthesise_calibration
from escape_hw.calibration.sprint.telemetry_fit import decorrelate_columns
from escape_hw.config.choices import ESTIMATORS
from escape_hw.errors import Aborted, ConfigError

#: Frames per mode below which the frames themselves are fitted even where there is a matrix: the errors of
#: one from so few frames look like white noise in what it leaves, and the filter found on that is too weak.
_FRAMES_PER_MODE = 10


def escape(
    bench: Bench,
    *,
    frames: int | None = None,
    poke: float | None = None,
    grid: SensorGeometry | None = None,
    whiten: bool = True,
    estimator: str | None = None,
    closed_loop: CalibrationResult | None = None,
    until: Target | None = None,
    checkpoint: Checkpoint | None = None,
) -> Procedure[CalibrationResult]:
    """Calibrate without a source: measure under turbulence, find the registration, synthesise.

    Parameters
    ----------
    bench, frames, poke, grid, whiten
        As for :func:`~escape_hw.calibration.docrime.open_loop.docrime`.
    estimator
        ``"matrix"``: SPRINT fits the DO-CRIME matrix, mode by mode, as the paper does.
        ``"telemetry"``: it fits what the whitened frames hold, which takes fewer frames than modes and
        loses nothing (see :mod:`~escape_hw.calibration.sprint.telemetry_fit`). As configured by default;
        ``"auto"`` is the second.
    closing
        Measure in closed loop, with this calibration's matrix
        (:func:`~escape_hw.calibration.docrime.closed_loop.docrime_closed_loop`).
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
    needs_matrix = c.solver in MATRIX_ONLY_SOLVERS
    if needs_matrix and estimator == "telemetry":
        raise ConfigError(
            f"calibration.solver = '{c.solver}' fits modes, and telemetry has none; "
            "choose estimator = 'matrix' or another solver"
        )
    from_matrix = estimator == "matrix" or not whiten or needs_matrix
    n_frames = c.frames if frames is None else frames
    n_modes = bench.config.basis.n_modes if closed_loop is None else closed_loop.matrix.n_modes
    if whiten and not from_matrix and n_frames < minimum_frames(c, n_modes):
        if closed_loop is not None:
            return (
                yield from calibrate_short_run_closed_loop(bench, closed_loop, frames=n_frames, poke=poke)
            )
        return (yield from calibrate_short_run(bench, frames=n_frames, poke=poke, grid=grid))
    m2c = build_modal_basis(bench) if closed_loop is None else closed_loop.matrix.m2c

    def criterion(solution: DocrimeSolution, grid: SensorGeometry) -> Procedure[bool]:
        matrix = build_solution_matrix(bench, grid, m2c, solution, "escape")
        if until is None or not until.is_snr_reached(matrix):
            return False
        if until.accuracy is None:
            return True
        estimate = yield from _fit_registration(bench, matrix, grid, solution, from_matrix)
        return estimate.converged and float(estimate.sigma[:2].max()) <= until.accuracy

    stop_condition = None if until is None else criterion
    if closed_loop is not None:
        if not whiten:
            raise ConfigError("the plain estimator is for open loop; in closed loop turbulence is whitened")
        run = yield from docrime_closed_run(
            bench, closed_loop, frames=frames, poke=poke, checkpoint=checkpoint, criterion=stop_condition
        )
    else:
        record_frames = not from_matrix and n_frames < _FRAMES_PER_MODE * n_modes
        run = yield from docrime_run(
            bench,
            frames=frames,
            poke=poke,
            grid=grid,
            whiten=whiten,
            checkpoint=checkpoint,
            criterion=stop_condition,
            record=record_frames,
        )
    measured, solution = run.result, run.solution
    if measured.partial:
        return measured
    try:
        if run.record is not None and run.record[0].size == measured.frames:
            order = bench.config.calibration.whiten_order
            fit = yield from fit_recorded_frames(bench, run.record, measured.matrix, measured.grid, order)
            estimate = fit.estimate
        else:
            estimate = yield from _fit_registration(
                bench, measured.matrix, measured.grid, solution, from_matrix
            )
    except Aborted:
        return replace(measured, partial=True)
    synthetic = synthesise_calibration(bench, measured.grid, estimate, measured.matrix.m2c)
    metrics = {**measured.matrix.metrics, **synthetic.matrix.metrics}
    return replace(
        measured,
        matrix=replace(synthetic.matrix, metrics=metrics),
        registration=_add_response_error(estimate, solution.gain_sigma),
        measured=measured.matrix,
        notes=(*measured.notes, *estimate.warnings, *estimate.notes),
    )


def _fit_registration(
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
        matrix = decorrelate_columns(matrix, solution.gram, solution.variance)
        modes = matrix.n_modes
    yield Reporter("synthetic model", 1, "model")(0)
    return (
        yield from estimate_registration(
            matrix,
            bench.model(grid),
            modes=modes,
            covariance=solution.covariance,
            update_priors=True,
            **sprint_options_from_config(c),
        )
    )


def _add_response_error(estimate: RegistrationEstimate, relative: float) -> RegistrationEstimate:
    """The estimate with the error that all modes share, which no fit to a matrix can tell."""
    gain = estimate.gain
    return replace(estimate, gain=replace(gain, sigma=float(np.hypot(gain.sigma, gain.value * relative))))
