"""DO-CRIME in closed loop: pokes beside the integrator, which are the instruments of its commands."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.matrix import InteractionMatrix
from escape_hw.api.procedure import Procedure, Progress, Reporter
from escape_hw.api.results import CalibrationResult
from escape_hw.api.sensor import SensorGeometry
from escape_hw.bench import Bench
from escape_hw.calibration.acquire import next_frame, some_frames
from escape_hw.calibration.background import BackgroundEstimator
from escape_hw.calibration.checkpoint import Checkpoint, fingerprint
from escape_hw.calibration.closed_loop import integrator_for, loop_notes, settled_residual
from escape_hw.calibration.docrime import (
    MOST_CORRELATED,
    DocrimeRun,
    matrix_of,
    notes_on,
    require_frames,
    snr_judge,
)
from escape_hw.calibration.docrime_estimator import DocrimeEstimator
from escape_hw.calibration.loop_run import CLOSING_S, LoopRecord, RunningLoop, require_undiverged
from escape_hw.calibration.poke_patterns import Pattern, RandomPokes, random_pattern
from escape_hw.calibration.preview import Preview
from escape_hw.calibration.sensor_setup import extractor, prepare_sensor, random_amplitudes
from escape_hw.calibration.stopping import Judge, Looks, Target
from escape_hw.errors import Aborted, ConfigError, TooFewFrames
from escape_hw.io.state_file import RunState

#: Frames after which a running loop asks whether the estimate will do.
_STRETCH = 500


class ClosedLoopPokes:
    """A loop that runs while pokes are injected and estimated beside it.

    Parameters
    ----------
    bench
        An open bench, its sensor prepared.
    matrix, grid
        What closes the loop.
    estimator
        Takes slopes, commands and pokes.
    looks
        What is done with the estimate on the way.
    """

    def __init__(
        self,
        bench: Bench,
        matrix: InteractionMatrix,
        grid: SensorGeometry,
        estimator: DocrimeEstimator,
        looks: Looks,
    ) -> None:
        self._bench, self._grid, self._looks, self._estimator = bench, grid, looks, estimator
        control = integrator_for(bench, matrix, grid)
        self._loop = RunningLoop(bench, matrix.m2c, extractor(bench, grid), control)
        self._enough = self._stopped = False
        self._preview = Preview(matrix.n_modes, lambda: grid)
        self._picture: Mapping[str, NDArray[np.float32]] = {}
        self._beside = BackgroundEstimator(estimator, patient=bench.simulated, look=self._look)

    @property
    def record(self) -> LoopRecord:
        """What the loop gathered."""
        return self._loop.record

    @property
    def skipped(self) -> int:
        """Frames that the estimate lost because its sums were behind."""
        return self._beside.skipped

    @property
    def grid(self) -> SensorGeometry:
        """The geometry with the motion of the closed loop, which a model of the sensor has to match."""
        return self._beside.motion.of(self._grid, closed=True)

    def restore(self, state: RunState) -> None:
        """Go on from what a run that was broken off has kept."""
        self._estimator.restore(state.values, state.arrays)
        self._beside.motion.restore(state.arrays["motion"])

    def poke(self, frames: int, pokes: Pattern, stage: str) -> Procedure[bool]:
        """Close the loop, poke until the estimator has so many frames, open it; the mirror ends flat.

        Returns
        -------
        bool
            Whether the operator stopped it early.

        Raises
        ------
        CalibrationError
            The loop diverged, or the sensor went dark.
        """
        bench, loop = self._bench, self._loop
        partial, closing = False, int(CLOSING_S * bench.wfs.settings.frame_rate_hz)
        bench.dm.flatten()
        # One frame first: what the camera lost while nobody read it is not a loss of the loop.
        next_frame(bench)
        try:
            with self._beside as beside:
                try:
                    yield from loop.run(closing, report=Reporter("closing the loop", closing))
                    done, report = self._estimator.taken, Reporter(stage, frames)
                    while done < frames and not self._enough and not loop.record.diverged:
                        stretch = min(_STRETCH, frames - done)
                        yield from self._shown(
                            loop.run(stretch, inject=pokes, observe=(beside,), report=report)
                        )
                        done += stretch
                        beside.catch_up()
                except Aborted:
                    # At once: the sums may have a while to go.
                    bench.dm.flatten()
                    partial = self._stopped = True
                beside.finish()
        finally:
            bench.dm.flatten()
        require_undiverged(self._loop.record)
        if partial:
            self._kept_and_judged(always=True)
        return partial

    def _shown(self, steps: Procedure[LoopRecord]) -> Iterator[Progress]:
        """Progress of the loop with the newest picture of the matrix."""
        for step in steps:
            picture, self._picture = self._picture, {}
            yield replace(step, arrays={**step.arrays, **picture}) if picture else step

    def _look(self, estimator: DocrimeEstimator) -> None:
        """Show, keep and judge the estimate, as far as it is due; in the estimator's thread."""
        if self._preview.due():
            self._picture = self._preview(estimator.preview)
        if not self._enough and not self._stopped and self._looks.due(estimator.taken):
            self._enough = self._kept_and_judged()

    def _kept_and_judged(self, *, always: bool = False) -> bool:
        """Whether the estimate will do; its progress is nobody's. False if the run is stopped meanwhile."""
        arrays = {"motion": self._beside.motion.state()}
        taken = self._estimator.taken
        procedure = self._looks.look(self._estimator, self.grid, taken, {}, arrays, always=always)
        while True:
            try:
                next(procedure)
            except StopIteration as done:
                return bool(done.value)
            if self._stopped:
                procedure.close()
                return False


def docrime_closed_run(
    bench: Bench,
    closing: CalibrationResult,
    *,
    frames: int | None = None,
    poke: float | None = None,
    correlations: bool = True,
    pattern: type[Pattern] = RandomPokes,
    keep: Checkpoint | None = None,
    judge: Judge | None = None,
) -> Procedure[DocrimeRun]:
    """As :func:`docrime_closed_loop`, with the solution beside the matrix; see ``docrime_run``."""
    c, m2c, grid = bench.config.calibration, closing.matrix.m2c, closing.grid
    n_frames = c.frames if frames is None else some_frames(frames)
    poke = c.poke if poke is None else poke
    pattern = random_pattern(c.pokes) if pattern is RandomPokes else pattern
    if c.whiten_order == 0:
        raise ConfigError("calibration.whiten_order is 0; in closed loop the turbulence must be whitened")
    amplitude = random_amplitudes(bench, m2c, poke)
    require_frames(c, n_frames, m2c.shape[1])
    estimator = DocrimeEstimator(
        grid.n_slopes, m2c.shape[1], order=c.whiten_order, lags=c.lags, closed=True,
        correlations=correlations and grid.n_slopes <= MOST_CORRELATED,
    )  # fmt: skip
    method = _method(pattern)
    settings = {"poke": poke, "correlations": correlations, "closed with": fingerprint(closing.matrix.data)}
    state = None if keep is None else keep.begin(bench, method, m2c, settings)
    prepare_sensor(bench)
    loop = ClosedLoopPokes(bench, closing.matrix, grid, estimator, Looks(keep, judge))
    if state is not None:
        loop.restore(state)
    stage = f"{pattern.title} in closed loop"
    partial = yield from loop.poke(n_frames, pattern(amplitude, bench.rng), stage)
    try:
        solution = estimator.solve()
    except TooFewFrames:
        if partial:
            raise Aborted(f"aborted after {estimator.taken} frames, too few for a matrix") from None
        raise
    residual = settled_residual(loop.record, bench.wfs.settings.frame_rate_hz)
    matrix = matrix_of(
        bench, grid, m2c, solution, method, poke=float(poke), shortened=loop.record.shortened,
        skipped=loop.skipped, loop_gain=bench.config.loop.gain,
        loop_residual_nm=float(np.sqrt(np.mean(np.square(residual)))) if residual.size else math.nan,
    )  # fmt: skip
    seconds = (solution.frames + solution.lost_frames) / bench.wfs.settings.frame_rate_hz
    result = CalibrationResult(
        matrix, loop.grid, solution.frames, solution.lost_frames, seconds, solution.response,
        partial=partial, notes=(*notes_on(solution, matrix), *_loop_notes(bench, loop)),
    )  # fmt: skip
    return DocrimeRun(result, solution)


def docrime_closed_loop(
    bench: Bench,
    closing: CalibrationResult,
    *,
    frames: int | None = None,
    poke: float | None = None,
    pattern: type[Pattern] = RandomPokes,
    until: Target | None = None,
    keep: Checkpoint | None = None,
) -> Procedure[CalibrationResult]:
    """Measure the interaction matrix while the loop is closed, by pokes beside the integrator.

    Unbiased for any controller, at pokes of a few thousandths of the stroke: see
    ``docs/theory/docrime.md``.

    Parameters
    ----------
    bench
        An open bench.
    closing
        A calibration whose matrix closes the loop, with the configured gain, leak and dropped modes; the
        measured matrix is on its grid and in its modes.
    frames, poke, pattern, until, keep
        As for :func:`~escape_hw.calibration.docrime.docrime`.

    Returns
    -------
    CalibrationResult
        On the grid of ``closing``, with the motion that the loop left. Stopped early, ``partial`` is true.

    Raises
    ------
    ConfigError, TooFewFrames, ProductError
        As for :func:`~escape_hw.calibration.docrime.docrime`; nothing moved.
    IncompatibleProduct
        The matrix belongs to another mirror, grid or camera region; nothing moved.
    CalibrationError
        The loop diverged, the sensor went dark, or it does not respond to the pokes.
    Aborted
        Stopped before a matrix could be solved.
    """
    judge = snr_judge(bench, closing.matrix.m2c, until, _method(pattern))
    run = yield from docrime_closed_run(
        bench, closing, frames=frames, poke=poke, correlations=False, pattern=pattern, keep=keep, judge=judge
    )
    return run.result


def _method(pattern: type[Pattern]) -> str:
    return f"{pattern.method}-closed"


def _loop_notes(bench: Bench, loop: ClosedLoopPokes) -> list[str]:
    """What to know of the loop that a matrix was measured in."""
    notes = loop_notes(loop.record, bench.wfs.settings.frame_rate_hz)
    if loop.skipped:
        notes.append(f"{loop.skipped} frames were lost to the estimate: its sums were behind the loop")
    return notes
