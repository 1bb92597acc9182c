"""DO-CRIME in closed loop: pokes added to the controller's command, used as instrumental variables."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.procedure import Procedure, Progress, Reporter
from escape_hw.api.results import CalibrationResult
from escape_hw.api.sensor import SensorGeometry
from escape_hw.bench import Bench
from escape_hw.calibration.acquisition.checkpoint import CLOSED_WITH, Checkpoint, fingerprint
from escape_hw.calibration.acquisition.frames import validate_frame_count
from escape_hw.calibration.acquisition.pokes import (
    PokeSequence,
    RandomPokes,
    compute_random_amplitudes,
    note_limited_poke,
    select_random_pokes,
)
from escape_hw.calibration.acquisition.preview import MatrixPreview
from escape_hw.calibration.acquisition.stopping import Target
from escape_hw.calibration.docrime.estimator import DocrimeEstimator
from escape_hw.calibration.docrime.estimator_thread import EstimatorThread
from escape_hw.calibration.docrime.monitor import RunMonitor, StoppingCriterion
from escape_hw.calibration.docrime.open_loop import (
    DocrimeRun,
    build_snr_criterion,
    build_solution_matrix,
    collect_solution_notes,
    require_enough_frames,
    solve_run,
)
from escape_hw.calibration.docrime.regression import MAX_CORRELATED_SLOPES
from escape_hw.calibration.loop.control import build_integrator
from escape_hw.calibration.loop.divergence import require_not_diverged
from escape_hw.calibration.loop.performance import collect_loop_notes, select_settled_residual
from escape_hw.calibration.loop.runner import LoopRecord, RunningLoop
from escape_hw.errors import Aborted, ConfigError
from escape_hw.io.fits.run_state import RunState
from escape_hw.pipeline.statistics import root_mean_square

#: Frames between two checks of the stopping criterion.
_CHECK_INTERVAL = 500


class ClosedLoopAcquisition:
    """A loop with injected pokes, and the estimator beside it."""

    def __init__(
        self,
        bench: Bench,
        matrix: InteractionMatrix,
        grid: SensorGeometry,
        estimator: DocrimeEstimator,
        monitor: RunMonitor,
    ) -> None:
        self._grid, self._monitor, self._estimator = grid, monitor, estimator
        self.loop = RunningLoop.prepare(bench, matrix, grid, build_integrator(bench, matrix, grid))
        self._criterion_met = self._aborted = False
        self._preview = MatrixPreview(matrix.n_modes, lambda: grid)
        self._preview_arrays: Mapping[str, NDArray[np.float32]] = {}
        self.estimator_thread = EstimatorThread(estimator, blocking=bench.simulated, on_block=self._on_block)

    @property
    def grid(self) -> SensorGeometry:
        """The geometry with the slope statistics of the closed loop."""
        return self.estimator_thread.slope_statistics.annotate_geometry(self._grid, closed=True)

    def restore(self, state: RunState) -> None:
        """Continue from a saved state."""
        self._estimator.restore(state.values, state.arrays)
        self.estimator_thread.slope_statistics.restore(state.arrays["motion"])

    def poke(self, frames: int, pokes: PokeSequence, stage: str) -> Procedure[bool]:
        """Close the loop, inject pokes until the estimator has a number of frames, and open the loop.

        Returns whether the run was aborted.

        Raises
        ------
        CalibrationError
            The loop diverged, or the sensor went dark.
        """
        loop, estimator_thread = self.loop, self.estimator_thread
        with loop.closed(), estimator_thread:
            try:
                yield from loop.settle()
                done, report = self._estimator.frames_received, Reporter(stage, frames)
                while done < frames and not self._criterion_met and not loop.record.diverged:
                    n_frames = min(_CHECK_INTERVAL, frames - done)
                    yield from self._with_preview(
                        loop.run(n_frames, inject=pokes, observe=(estimator_thread,), report=report)
                    )
                    done += n_frames
                    estimator_thread.wait_until_summed()
            except Aborted:
                # At once, because the sums may take a while.
                loop.open()
                self._aborted = True
            estimator_thread.finish()
        require_not_diverged(loop.record.diverged, loop.record.frames)
        if self._aborted:
            self._save_and_check(final=True)
        return self._aborted

    def _with_preview(self, steps: Procedure[LoopRecord]) -> Iterator[Progress]:
        """Progress of the loop with the latest preview of the matrix."""
        for step in steps:
            preview_arrays, self._preview_arrays = self._preview_arrays, {}
            yield replace(step, arrays={**step.arrays, **preview_arrays}) if preview_arrays else step

    def _on_block(self, estimator: DocrimeEstimator) -> None:
        """Preview, save and check the estimate, as far as each is due; in the estimator's thread."""
        if self._preview.is_due():
            self._preview_arrays = self._preview(estimator.preview)
        if not self._criterion_met and not self._aborted and self._monitor.is_due(estimator.frames_received):
            self._criterion_met = self._save_and_check()

    def _save_and_check(self, *, final: bool = False) -> bool:
        """Whether the criterion is met, without reporting progress; false if the run is aborted meanwhile."""
        arrays = {"motion": self.estimator_thread.slope_statistics.state()}
        frames_received = self._estimator.frames_received
        procedure = self._monitor.check(self._estimator, self.grid, frames_received, {}, arrays, final=final)
        while True:
            try:
                next(procedure)
            except StopIteration as done:
                return bool(done.value)
            if self._aborted:
                procedure.close()
                return False


def docrime_closed_run(
    bench: Bench,
    closed_loop: CalibrationResult,
    *,
    frames: int | None = None,
    poke: float | None = None,
    correlations: bool = True,
    pattern: type[PokeSequence] = RandomPokes,
    checkpoint: Checkpoint | None = None,
    criterion: StoppingCriterion | None = None,
) -> Procedure[DocrimeRun]:
    """Run :func:`docrime_closed_loop` and return also the solution; parameters as for ``docrime_run``."""
    c, m2c, grid = bench.config.calibration, closed_loop.matrix.m2c, closed_loop.grid
    n_frames = c.frames if frames is None else validate_frame_count(frames)
    poke = c.poke if poke is None else poke
    pattern = select_random_pokes(c.pokes) if pattern is RandomPokes else pattern
    if c.whiten_order == 0:
        raise ConfigError("calibration.whiten_order is 0; in closed loop the turbulence must be whitened")
    amplitude = compute_random_amplitudes(bench, m2c, poke)
    require_enough_frames(c, n_frames, m2c.shape[1])
    estimator = DocrimeEstimator(
        grid.n_slopes, m2c.shape[1], order=c.whiten_order, lags=c.lags, closed=True,
        correlations=correlations and grid.n_slopes <= MAX_CORRELATED_SLOPES,
    )  # fmt: skip
    method = f"{pattern.method}-closed"
    closed_with = fingerprint(closed_loop.matrix.data)
    settings = {"poke": poke, "correlations": correlations, CLOSED_WITH: closed_with}
    state = None if checkpoint is None else checkpoint.begin(bench, method, m2c, settings)
    acquisition = ClosedLoopAcquisition(
        bench, closed_loop.matrix, grid, estimator, RunMonitor(checkpoint, criterion)
    )
    if state is not None:
        acquisition.restore(state)
    stage = f"{pattern.title} in closed loop"
    partial = yield from acquisition.poke(n_frames, pattern(amplitude, bench.rng), stage)
    solution = solve_run(estimator, partial, estimator.frames_received)
    record, skipped = acquisition.loop.record, acquisition.estimator_thread.skipped
    residual = select_settled_residual(record, bench.wfs.settings.frame_rate_hz)
    matrix = build_solution_matrix(
        bench, grid, m2c, solution, method, poke=float(amplitude.max()),
        clipped_pokes=record.shortened, skipped=skipped, loop_gain=bench.config.loop.gain,
        loop_residual_nm=root_mean_square(residual),
    )  # fmt: skip
    seconds = (solution.frames + solution.lost_frames) / bench.wfs.settings.frame_rate_hz
    notes = [
        *collect_solution_notes(solution, matrix),
        *collect_loop_notes(record, bench.wfs.settings.frame_rate_hz),
        *note_limited_poke(bench, amplitude, poke),
    ]
    if skipped:
        notes.append(f"the estimate skipped {skipped} frames, because its sums were behind the loop")
    result = CalibrationResult(
        matrix, acquisition.grid, solution.frames, solution.lost_frames, seconds, solution.response,
        partial=partial, notes=tuple(notes),
    )  # fmt: skip
    return DocrimeRun(result, solution)


def docrime_closed_loop(
    bench: Bench,
    closed_loop: CalibrationResult,
    *,
    frames: int | None = None,
    poke: float | None = None,
    pattern: type[PokeSequence] = RandomPokes,
    until: Target | None = None,
    checkpoint: Checkpoint | None = None,
) -> Procedure[CalibrationResult]:
    """Measure the interaction matrix in closed loop, by pokes added to the controller's command.

    Unbiased for any controller, with pokes of a few thousandths of the stroke (``docs/theory/docrime.md``).

    Parameters
    ----------
    closed_loop
        Calibration whose matrix closes the loop with the configured gain, leak and dropped modes; the
        measured matrix has its geometry and modes.
    frames, poke, pattern, until, checkpoint
        As for :func:`~escape_hw.calibration.docrime.open_loop.docrime`.

    Returns
    -------
    CalibrationResult
        On the geometry of ``closed_loop``, with the slope statistics of the closed loop. After an abort
        ``partial`` is true.

    Raises
    ------
    ConfigError, TooFewFrames, ProductError
        As for :func:`~escape_hw.calibration.docrime.open_loop.docrime`; nothing moved.
    IncompatibleProduct
        The matrix belongs to another mirror, grid or camera region; nothing moved.
    CalibrationError
        The loop diverged, the sensor went dark, or it does not respond to the pokes.
    Aborted
        Aborted before a matrix could be solved.
    """
    criterion = build_snr_criterion(bench, closed_loop.matrix.m2c, until, f"{pattern.method}-closed")
    run = yield from docrime_closed_run(
        bench, closed_loop, frames=frames, poke=poke, correlations=False, pattern=pattern,
        checkpoint=checkpoint, criterion=criterion,
    )  # fmt: skip
    return run.result
