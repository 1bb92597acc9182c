"""DO-CRIME in open loop: random pokes on all modes, under turbulence (paper; Lai et al. 2020)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.procedure import Procedure
from escape_hw.api.representation import short_repr
from escape_hw.api.results import CalibrationResult
from escape_hw.api.sensor import SensorGeometry
from escape_hw.bench import Bench
from escape_hw.calibration.acquisition.checkpoint import Checkpoint
from escape_hw.calibration.acquisition.frames import build_interaction_matrix, validate_frame_count
from escape_hw.calibration.acquisition.pokes import (
    PokeSequence,
    RandomPokes,
    compute_random_amplitudes,
    note_limited_poke,
    select_random_pokes,
)
from escape_hw.calibration.acquisition.sensor_setup import SETUP_FRAMES
from escape_hw.calibration.acquisition.stopping import Target, reject_accuracy_target
from escape_hw.calibration.docrime.acquisition import AcquisitionRecord, OpenLoopAcquisition
from escape_hw.calibration.docrime.estimator import DocrimeEstimator
from escape_hw.calibration.docrime.fit import DocrimeSolution
from escape_hw.calibration.docrime.monitor import RunMonitor, StoppingCriterion
from escape_hw.calibration.docrime.regression import MAX_CORRELATED_SLOPES
from escape_hw.calibration.modes.bases import build_modal_basis
from escape_hw.config.system import CalibrationSection
from escape_hw.errors import Aborted, TooFewFrames

#: Share of the response in its last frame above which it may continue beyond.
_TAIL_FRACTION = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class DocrimeRun:
    """A DO-CRIME run: its calibration, the solution behind it, and its telemetry if it was recorded."""

    result: CalibrationResult
    solution: DocrimeSolution
    record: AcquisitionRecord | None = None
    __repr__ = short_repr


def docrime_run(
    bench: Bench,
    *,
    frames: int | None = None,
    poke: float | None = None,
    whiten: bool = True,
    grid: SensorGeometry | None = None,
    record: bool = False,
    correlations: bool = True,
    pattern: type[PokeSequence] = RandomPokes,
    checkpoint: Checkpoint | None = None,
    criterion: StoppingCriterion | None = None,
) -> Procedure[DocrimeRun]:
    """Run :func:`docrime` and return also the solution.

    Parameters
    ----------
    bench, frames, poke, whiten, grid, pattern, checkpoint
        As for :func:`docrime`.
    correlations
        Whether to estimate the correlations of the slopes' noise, up to
        :data:`~escape_hw.calibration.docrime.regression.MAX_CORRELATED_SLOPES` slopes.
    """
    c = bench.config.calibration
    n_frames = c.frames if frames is None else validate_frame_count(frames)
    poke = c.poke if poke is None else poke
    pattern = select_random_pokes(c.pokes) if pattern is RandomPokes else pattern
    m2c = build_modal_basis(bench)
    amplitude = compute_random_amplitudes(bench, m2c, poke)
    require_enough_frames(c, n_frames, m2c.shape[1], whiten)
    order, lags = c.whiten_order if whiten else 0, c.lags

    def estimator(n_slopes: int) -> DocrimeEstimator:
        with_correlations = correlations and n_slopes <= MAX_CORRELATED_SLOPES
        return DocrimeEstimator(
            n_slopes, m2c.shape[1], order=order, lags=lags, correlations=with_correlations
        )

    acquisition = OpenLoopAcquisition(
        bench, m2c, grid, min(SETUP_FRAMES, n_frames), estimator,
        store_samples=record, monitor=RunMonitor(checkpoint, criterion),
    )  # fmt: skip
    settings = {"poke": poke, "whiten": whiten, "correlations": correlations}
    state = None if checkpoint is None else checkpoint.begin(bench, pattern.method, m2c, settings)
    if state is not None:
        acquisition.restore(state)
    partial = yield from acquisition.poke(n_frames, pattern(amplitude, bench.rng), pattern.title)
    sensor = acquisition.sensor
    if sensor.estimator is None:
        raise RuntimeError("the acquisition has no estimator")
    solution = solve_run(sensor.estimator, partial, acquisition.n_received)
    method = pattern.method + ("-whitened" if whiten and issubclass(pattern, RandomPokes) else "")
    matrix = build_solution_matrix(
        bench, sensor.grid, m2c, solution, method, poke=float(amplitude.max()),
        clipped_pokes=acquisition.shortened,
    )  # fmt: skip
    notes = note_limited_poke(bench, amplitude, poke)
    return DocrimeRun(_result(acquisition, matrix, solution, partial, notes), solution, acquisition.record())


def solve_run(estimator: DocrimeEstimator, aborted: bool, n_frames: int) -> DocrimeSolution:
    """Solve the sums of a run of ``n_frames``; :class:`Aborted` if it was aborted too early."""
    try:
        return estimator.solve()
    except TooFewFrames:
        if aborted:
            raise Aborted(f"aborted after {n_frames} frames, too few for a matrix") from None
        raise


def build_solution_matrix(
    bench: Bench,
    grid: SensorGeometry,
    m2c: NDArray[np.float64],
    solution: DocrimeSolution,
    method: str,
    **metrics: float | int | str,
) -> InteractionMatrix:
    """Build the interaction matrix of a solution with its provenance and metrics."""
    return build_interaction_matrix(
        bench, grid, m2c, solution.matrix, solution.sigma, method,
        frames=solution.frames, lost_frames=solution.lost_frames, delay_frames=solution.response.delay_frames,
        whitening_order=solution.whitener.size - 1, gain_sigma=solution.gain_sigma, **metrics,
    )  # fmt: skip


def collect_solution_notes(solution: DocrimeSolution, matrix: InteractionMatrix) -> list[str]:
    """Notes on the quality of a solution."""
    notes = []
    if float(np.median(matrix.snr())) < 1:
        notes.append("the median mode has a signal-to-noise ratio below 1; use more frames or larger pokes")
    tail, error = solution.response.weights[-1], solution.response.sigma[-1]
    if abs(tail) > max(_TAIL_FRACTION, 4 * error):
        notes.append(
            f"{tail:.0%} of the response is in the last lag, {solution.response.weights.size - 1} frames "
            "after a command; a part beyond it would scale the matrix: raise calibration.lags"
        )
    return notes


def build_snr_criterion(
    bench: Bench, m2c: NDArray[np.float64], until: Target | None, method: str
) -> StoppingCriterion | None:
    """Build the stopping criterion of a target signal-to-noise ratio; ``None`` without a target.

    Raises
    ------
    ConfigError
        The target is an accuracy, which only a registration has.
    """
    reject_accuracy_target(until)
    if until is None:
        return None

    def criterion(solution: DocrimeSolution, grid: SensorGeometry) -> Procedure[bool]:
        yield from ()
        return until.is_snr_reached(build_solution_matrix(bench, grid, m2c, solution, method))

    return criterion


def _result(
    acquisition: OpenLoopAcquisition,
    matrix: InteractionMatrix,
    solution: DocrimeSolution,
    partial: bool,
    notes: list[str],
) -> CalibrationResult:
    """The calibration with the geometry improved by all frames."""
    seconds = (solution.frames + solution.lost_frames) / acquisition.bench.wfs.settings.frame_rate_hz
    return CalibrationResult(
        matrix,
        acquisition.build_final_geometry(),
        solution.frames,
        solution.lost_frames,
        seconds,
        solution.response,
        partial=partial,
        mean_frame=acquisition.sensor.mean_frame,
        notes=(*collect_solution_notes(solution, matrix), *acquisition.notes(), *notes),
    )


def docrime(
    bench: Bench,
    *,
    frames: int | None = None,
    poke: float | None = None,
    whiten: bool = True,
    grid: SensorGeometry | None = None,
    pattern: type[PokeSequence] = RandomPokes,
    until: Target | None = None,
    checkpoint: Checkpoint | None = None,
) -> Procedure[CalibrationResult]:
    """Measure the interaction matrix by random pokes, with or without turbulence.

    The geometry of the sensor is found on the first frames of the run itself, which takes no extra sky time.

    Parameters
    ----------
    bench
        An open bench, loop open.
    frames
        Number of frames; by default as configured.
    poke
        Amplitude: pokes are uniform in +-poke on every mode, rms surface as fraction of full stroke.
    whiten
        Whether to subtract the part of the turbulence that past frames predict; false for the paper's
        estimator.
    grid
        Geometry of the sensor, if it is known.
    pattern
        Poke sequence; :class:`~escape_hw.calibration.acquisition.pokes.PushPullPokes` for fast push-pull.
    until
        Target at which the run stops before its number of frames.
    checkpoint
        Where the state is saved, and the state to resume from.

    Returns
    -------
    CalibrationResult
        With the measured temporal response. After an abort ``partial`` is true.

    Raises
    ------
    ConfigError
        The number of frames, the poke or the target is out of range; nothing moved.
    TooFewFrames
        Too few frames for the number of modes; nothing moved.
    CalibrationError
        No spots or pupil images, no light, no response, or pokes that do not span the modes.
    ProductError
        The state to resume from is damaged or of another run; nothing moved.
    Aborted
        Aborted before a matrix could be solved.
    """
    criterion = (
        None if until is None else build_snr_criterion(bench, build_modal_basis(bench), until, pattern.method)
    )
    run = yield from docrime_run(
        bench, frames=frames, poke=poke, whiten=whiten, grid=grid, correlations=False, pattern=pattern,
        checkpoint=checkpoint, criterion=criterion,
    )  # fmt: skip
    return run.result


def minimum_frames(settings: CalibrationSection, n_modes: int, whiten: bool = True) -> int:
    """Fewest frames of a run: twice the number of unknowns per slope."""
    return 2 * (n_modes + (settings.whiten_order if whiten else 0) + settings.lags)


def require_enough_frames(
    settings: CalibrationSection, frames: int, n_modes: int, whiten: bool = True
) -> None:
    """Raise :class:`TooFewFrames` for fewer frames than :func:`minimum_frames`."""
    needed = minimum_frames(settings, n_modes, whiten)
    if frames < needed:
        raise TooFewFrames(
            f"{frames} frames cannot constrain {n_modes} modes; ask for at least {needed} frames, "
            "or for fewer modes (basis.n_modes)"
        )
