"""The ESCAPE method: DO-CRIME, then SPRINT, then the pseudo-synthetic interaction matrix (the paper)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.procedure import Procedure, Reporter
from escape_hw.api.results import CalibrationResult, RegistrationEstimate
from escape_hw.api.sensor import SensorGeometry
from escape_hw.api.synthetic_model import SyntheticModel
from escape_hw.bench import Bench
from escape_hw.calibration.acquisition.checkpoint import Checkpoint
from escape_hw.calibration.acquisition.frames import validate_frame_count
from escape_hw.calibration.acquisition.stopping import Target
from escape_hw.calibration.docrime.closed_loop import docrime_closed_run
from escape_hw.calibration.docrime.fit import DocrimeSolution
from escape_hw.calibration.docrime.monitor import StoppingCriterion
from escape_hw.calibration.docrime.open_loop import (
    DocrimeRun,
    build_solution_matrix,
    docrime_run,
    minimum_frames,
    require_enough_frames,
)
from escape_hw.calibration.escape.short_runs import (
    calibrate_short_run,
    calibrate_short_run_closed_loop,
    choose_whitening_order,
    fit_recorded_frames,
)
from escape_hw.calibration.modes.bases import build_modal_basis
from escape_hw.calibration.sprint.fit import fit_registration, sprint_options_from_config
from escape_hw.calibration.sprint.solvers import MATRIX_ONLY_SOLVERS
from escape_hw.calibration.sprint.synthetic_matrix import compute_fitted_jacobian, synthesise_calibration
from escape_hw.calibration.sprint.telemetry_fit import decorrelate_columns
from escape_hw.config.choices import ESTIMATORS
from escape_hw.config.system import CalibrationSection
from escape_hw.deprecation import renamed_keywords
from escape_hw.errors import Aborted, ConfigError

#: Frames per mode below which the recorded frames are fitted even though there is a matrix: the errors of
#: such a matrix appear as white noise in its residual, so the whitening filter estimated from it is too weak.
_FRAMES_PER_MODE = 10


@renamed_keywords(closing="closed_loop", keep="checkpoint")
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
    """Calibrate without a source: measure under turbulence, fit the registration, synthesise the matrix.

    A run of fewer frames than a measured matrix takes (:func:`is_short_run`) fits the registration once,
    after its last frame.

    Parameters
    ----------
    bench, frames, poke, whiten
        As for :func:`~escape_hw.calibration.docrime.open_loop.docrime`.
    grid
        Geometry of the sensor, if it is known; in closed loop that of ``closed_loop`` is used.
    estimator
        ``"matrix"``: SPRINT fits the DO-CRIME matrix, mode by mode, as the paper does. ``"telemetry"``: it
        fits the whitened frames without loss of information, also fewer frames than modes
        (:mod:`~escape_hw.calibration.sprint.telemetry_fit`). ``"auto"``: telemetry where possible. As
        configured by default.
    closed_loop
        Calibration whose matrix closes the loop during the measurement; open loop by default.
    until
        Target at which to stop before that number of frames. A short run has no measured matrix, so it
        refuses a signal-to-noise ratio; it takes all its frames, and a note of the result states whether the
        accuracy was reached.
    checkpoint
        File for the state of the run, from which it can be resumed. A short run refuses it.

    Returns
    -------
    CalibrationResult
        ``matrix`` is pseudo-synthetic, ``measured`` the DO-CRIME matrix (``None`` for a short run),
        ``registration`` the result of SPRINT; do not use the matrix unless ``registration.converged``. If
        the run was aborted, ``matrix`` is the DO-CRIME matrix, ``partial`` is true and ``registration`` is
        ``None``.

    Raises
    ------
    ConfigError
        Unknown estimator, the plain estimator in closed loop, or a target or checkpoint that a short run
        cannot have; nothing moved.
    TooFewFrames, CalibrationError, ProductError, Aborted
        As for DO-CRIME.
    """
    c = bench.config.calibration
    from_matrix = _fits_matrix(c, whiten, estimator)
    n_frames = c.frames if frames is None else validate_frame_count(frames)
    n_modes = bench.config.basis.n_modes if closed_loop is None else closed_loop.matrix.n_modes
    require_enough_frames_for_escape(
        c, n_modes, frames=n_frames, whiten=whiten, estimator=estimator, until=until, checkpoint=checkpoint
    )
    if is_short_run(c, n_modes, frames=n_frames, whiten=whiten, estimator=estimator):
        if closed_loop is None:
            short = yield from calibrate_short_run(bench, frames=n_frames, poke=poke, grid=grid)
        else:
            short = yield from calibrate_short_run_closed_loop(bench, closed_loop, frames=n_frames, poke=poke)
        return _note_accuracy(short, until)
    m2c = build_modal_basis(bench) if closed_loop is None else closed_loop.matrix.m2c
    criterion = _build_criterion(bench, m2c, until, from_matrix)
    if closed_loop is not None:
        if not whiten:
            raise ConfigError("the plain estimator is for open loop; in closed loop turbulence is whitened")
        run = yield from docrime_closed_run(
            bench, closed_loop, frames=frames, poke=poke, checkpoint=checkpoint, criterion=criterion
        )
    else:
        run = yield from docrime_run(
            bench, frames=frames, poke=poke, grid=grid, whiten=whiten, checkpoint=checkpoint,
            criterion=criterion, record=not from_matrix and n_frames < _FRAMES_PER_MODE * n_modes,
        )  # fmt: skip
    return (yield from _synthesise_from_run(bench, run, from_matrix))


def _build_criterion(
    bench: Bench, m2c: NDArray[np.float64], until: Target | None, from_matrix: bool
) -> StoppingCriterion | None:
    """Build the stopping criterion of a target; ``None`` without a target."""
    if until is None:
        return None

    def criterion(solution: DocrimeSolution, grid: SensorGeometry) -> Procedure[bool]:
        matrix = build_solution_matrix(bench, grid, m2c, solution, "escape")
        if not until.is_snr_reached(matrix):
            return False
        if until.accuracy is None:
            return True
        model = yield from _build_model(bench, grid)
        estimate = yield from _fit_solution(bench, matrix, model, solution, from_matrix)
        return estimate.converged and float(estimate.sigma[:2].max()) <= until.accuracy

    return criterion


def is_short_run(
    c: CalibrationSection,
    n_modes: int,
    *,
    frames: int | None,
    whiten: bool = True,
    estimator: str | None = None,
) -> bool:
    """Whether a run has fewer frames than a measured matrix takes, so that telemetry is fitted directly.

    Parameters as for :func:`escape`. Raises :class:`ConfigError` for an unknown estimator, or one that does
    not go with the configured solver.
    """
    n_frames = c.frames if frames is None else frames
    return not _fits_matrix(c, whiten, estimator) and n_frames < minimum_frames(c, n_modes)


def require_enough_frames_for_escape(
    c: CalibrationSection,
    n_modes: int,
    *,
    frames: int,
    whiten: bool = True,
    estimator: str | None = None,
    until: Target | None = None,
    checkpoint: object | None = None,
) -> None:
    """Check that a number of frames is enough for the estimator and the options of a run.

    Parameters as for :func:`escape`; ``checkpoint`` is any object if the state is saved or resumed from.

    Raises
    ------
    ConfigError, TooFewFrames
        As :func:`escape`.
    """
    if not is_short_run(c, n_modes, frames=frames, whiten=whiten, estimator=estimator):
        require_enough_frames(c, frames, n_modes, whiten)
        return
    _require_short_run_options(until, checkpoint, frames, minimum_frames(c, n_modes), n_modes)
    choose_whitening_order(c, frames)


def _fits_matrix(c: CalibrationSection, whiten: bool, estimator: str | None) -> bool:
    """Whether SPRINT fits the columns of a matrix as modes, rather than the whitened frames."""
    estimator = c.estimator if estimator is None else estimator
    if estimator not in ESTIMATORS:
        raise ConfigError(f"estimator '{estimator}' is unknown; it is one of {', '.join(ESTIMATORS)}")
    needs_matrix = c.solver in MATRIX_ONLY_SOLVERS
    if needs_matrix and estimator == "telemetry":
        raise ConfigError(
            f"calibration.solver = '{c.solver}' fits modes, and telemetry has none; "
            "choose estimator = 'matrix' or another solver"
        )
    return estimator == "matrix" or not whiten or needs_matrix


def _require_short_run_options(
    until: Target | None, checkpoint: object | None, n_frames: int, needed: int, n_modes: int
) -> None:
    """Raise :class:`ConfigError` for options that need a measured matrix."""
    reason = f"a run of {n_frames} frames is too short for a measured matrix of {n_modes} modes"
    if checkpoint is not None:
        raise ConfigError(
            f"{reason} and cannot be resumed; leave out the checkpoint, or ask for at least {needed} frames"
        )
    if until is not None and until.snr is not None:
        raise ConfigError(
            f"{reason}, so it has no signal-to-noise ratio; ask for an accuracy instead, or for at least "
            f"{needed} frames"
        )


def _note_accuracy(result: CalibrationResult, until: Target | None) -> CalibrationResult:
    """The result of a short run, with a note on the accuracy that was asked for."""
    if until is None or until.accuracy is None or result.registration is None:
        return result
    worst = float(result.registration.sigma[:2].max())
    note = (
        f"standard error of the shifts: {worst:.3g} % of a sub-aperture, accuracy asked for: "
        f"{until.accuracy:g} % ({'reached' if worst <= until.accuracy else 'not reached; use more frames'})"
    )
    return replace(result, notes=(*result.notes, note))


def _synthesise_from_run(bench: Bench, run: DocrimeRun, from_matrix: bool) -> Procedure[CalibrationResult]:
    """Fit the registration of a DO-CRIME run and synthesise its matrix."""
    measured, solution = run.result, run.solution
    if measured.partial:
        return measured
    try:
        model = yield from _build_model(bench, measured.grid)
        if run.record is not None and run.record[0].size == measured.frames:
            order = bench.config.calibration.whiten_order
            fit = yield from fit_recorded_frames(bench, run.record, measured.matrix, model, order)
            estimate = fit.estimate
        else:
            estimate = yield from _fit_solution(bench, measured.matrix, model, solution, from_matrix)
    except Aborted:
        return replace(measured, partial=True)
    m2c = measured.matrix.m2c
    fitted = compute_fitted_jacobian(model, estimate, m2c)
    synthetic = synthesise_calibration(bench, measured.grid, estimate, m2c, fitted)
    metrics = {**measured.matrix.metrics, **synthetic.matrix.metrics}
    # The error of the temporal response is common to all modes, so no fit to the matrix contains it.
    gain = estimate.gain
    gain_sigma = float(np.hypot(gain.sigma, gain.value * solution.gain_sigma))
    return replace(
        measured,
        matrix=replace(synthetic.matrix, metrics=metrics),
        registration=replace(estimate, gain=replace(gain, sigma=gain_sigma)),
        measured=measured.matrix,
        notes=(*measured.notes, *estimate.warnings, *estimate.notes),
    )


def _build_model(bench: Bench, grid: SensorGeometry) -> Procedure[SyntheticModel]:
    """Build the synthetic model of a run, which takes long on a pyramid."""
    yield Reporter("synthetic model", 1, "model")(0)
    return bench.model(grid)


def _fit_solution(
    bench: Bench,
    matrix: InteractionMatrix,
    model: SyntheticModel,
    solution: DocrimeSolution,
    from_matrix: bool,
) -> Procedure[RegistrationEstimate]:
    """SPRINT on a DO-CRIME solution: on its modes, or on its columns with independent noise."""
    c = bench.config.calibration
    modes = min(c.sprint_modes, matrix.n_modes)
    if not from_matrix:
        matrix = decorrelate_columns(matrix, solution.gram, solution.variance)
        modes = matrix.n_modes
    fit = yield from fit_registration(
        matrix, model, modes=modes, covariance=solution.covariance, update_priors=True,
        **sprint_options_from_config(c),
    )  # fmt: skip
    return fit.estimate
