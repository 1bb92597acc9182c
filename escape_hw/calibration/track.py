"""The tracker: closed loop for hours while the registration, the seeing and the optical gains change.

Small pokes run beside the integrator all the time. Once a second the frames of that second go to a
thread of their own, which makes the live registration (:mod:`~.live_registration`) and holds the
pseudo-synthetic matrix that follows from it against the one in use; the loop takes the answer up a
second later and never waits open. An exchange keeps the integrator's state, so the mirror does not jump.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.matrix import InteractionMatrix
from escape_hw.api.procedure import Procedure, Progress, Reporter
from escape_hw.api.results import RegistrationEstimate, TemporalResponse
from escape_hw.api.sensor import SensorGeometry
from escape_hw.api.tracking import Alarm, TrackResult
from escape_hw.bench import Bench
from escape_hw.calibration.acquire import Motion, next_frame
from escape_hw.calibration.closed_loop import integrator_for
from escape_hw.calibration.found_mirror import found_matrix
from escape_hw.calibration.gain_curve import SCATTER
from escape_hw.calibration.live_registration import LiveRegistration
from escape_hw.calibration.loop_run import RunningLoop
from escape_hw.calibration.loop_tape import LoopTape
from escape_hw.calibration.pseudo_synthetic import synthesise
from escape_hw.calibration.sensor_setup import extractor, poke_amplitudes, prepare_sensor
from escape_hw.calibration.sprint import sprint
from escape_hw.calibration.sprint_settings import as_configured
from escape_hw.calibration.telemetry import Telemetry
from escape_hw.calibration.track_answer import SHOWN, Answer, row_of, to_show
from escape_hw.calibration.track_proposal import InUse, Proposal, inverted, propose, taken
from escape_hw.calibration.track_watch import RunawayWatch, TrackWatch
from escape_hw.errors import Aborted, CalibrationError, ConfigError, TooFewFrames
from escape_hw.pipeline.frame_stack import FrameStack
from escape_hw.pipeline.standard_error import LEAST
from escape_hw.pipeline.strehl import strehl

log = logging.getLogger(__name__)

#: Seconds between two looks at the registration.
STEP_S = 1.0
#: Seconds in which the loop closes, and then those in which the slopes' motion is measured.
_CLOSING_S, _MOTION_S = 0.3, 1.0
#: Updates before the first exchange: the memory must hold something first.
_FIRST_EXCHANGE = 3
#: Updates over which a Strehl ratio is taken.
_STREHL_EVERY = 5


def track(
    bench: Bench,
    matrix: InteractionMatrix,
    grid: SensorGeometry,
    *,
    seconds: float = 60.0,
    registration: RegistrationEstimate | None = None,
    response: TemporalResponse | None = None,
    poke: float | None = None,
    memory_s: float | None = None,
    exchange: bool = True,
    gain: float | None = None,
    model_psf: NDArray[np.float32] | None = None,
) -> Procedure[TrackResult]:
    """Run the loop and follow what drifts.

    Parameters
    ----------
    bench
        An open bench.
    matrix, grid
        The matrix to begin with, and its grid.
    seconds
        How long.
    registration
        The registration behind the matrix; found from the matrix itself by default.
    response
        Temporal response, where it is known.
    poke
        Pokes are uniform in +-poke on every mode, rms surface as fraction of full stroke; as configured.
    memory_s
        Time in which old frames fade; as configured by default.
    exchange
        Whether a new matrix may be taken into use without asking, within the configured limits; false:
        new matrices are only proposed.
    gain
        Gain of the integrator; as configured by default.
    model_psf
        PSF without turbulence; with it the Strehl ratio is followed, too.

    Returns
    -------
    TrackResult
        ``partial`` when stopped early; ``stable`` false when the loop was lost.

    Raises
    ------
    ConfigError
        A time, poke or memory that means nothing; nothing moved.
    IncompatibleProduct, CalibrationError
        The matrix does not fit, cannot be inverted, or shows no registration; nothing moved.
    """
    t = bench.config.tracking
    poke = t.poke if poke is None else poke
    memory = t.memory_s if memory_s is None else memory_s
    if not (STEP_S <= seconds < math.inf and 0 < poke < math.inf and 0 < memory < math.inf):
        raise ConfigError(
            f"seconds is {seconds}, poke {poke} and memory_s {memory}; the first must be at least "
            f"{STEP_S:g}, the others positive"
        )
    tracker = _Tracker(bench, matrix, grid, registration, response, poke, memory, exchange, gain, model_psf)
    return (yield from tracker.run(seconds))


class _Tracker:
    """State of a run."""

    def __init__(
        self,
        bench: Bench,
        matrix: InteractionMatrix,
        grid: SensorGeometry,
        registration: RegistrationEstimate | None,
        response: TemporalResponse | None,
        poke: float,
        memory_s: float,
        exchange: bool,
        gain: float | None,
        model_psf: NDArray[np.float32] | None,
    ) -> None:
        c, t = bench.config.calibration, bench.config.tracking
        self.bench, self.grid, self.exchange, self.psf = bench, grid, exchange, model_psf
        self.control = integrator_for(bench, matrix, grid, gain=gain)
        start = registration or sprint(matrix, bench.model(grid), **as_configured(c))
        if not start.converged:
            raise CalibrationError(f"no registration to begin with: {'; '.join(start.warnings)}")
        self.amplitude = poke_amplitudes(bench, matrix.m2c, poke)
        self.response, self.memory = response, memory_s / STEP_S
        self.dropped = bench.config.loop.dropped_modes
        self.used = InUse(matrix, inverted(matrix, self.dropped), start, 1.0)
        self.watch = TrackWatch(start.registration, t.largest_shift, response)
        self.result = TrackResult(poke=poke)
        self.frames = max(1, round(STEP_S * bench.wfs.settings.frame_rate_hz))
        self.tape = LoopTape(grid.n_slopes, matrix.n_modes, self.frames, 2 * c.whiten_order + c.lags)
        self.updates, self.residual_at = 0, 0
        self.pending: Future[Answer | None] | None = None
        self.metrics: dict[str, float] = {}
        self.arrays: dict[str, NDArray[np.float32]] = {}
        self.runaway = RunawayWatch()

    def prepare(self, motion: Motion) -> None:
        """Build the model for the light that the closed loop leaves, and start on it; in the thread.

        How a sensor answers depends on how much its light moves, and in closed loop that is less than
        while the matrix was measured.
        """
        bench, matrix, start = self.bench, self.used.matrix, self.used.registration
        c = bench.config.calibration
        self.grid = motion.of(self.grid, closed=True)
        self.model = bench.model(self.grid)
        self.live = LiveRegistration(
            matrix, self.model, start, order=c.whiten_order, lags=c.lags,
            memory=self.memory, step_s=STEP_S, response=self.response,
            curved=len(SCATTER) if bench.config.sensor.kind == "pyramid" else 0,
        )  # fmt: skip
        unit = found_matrix(self.model, start.registration, start, matrix.m2c)
        self.begun = (unit * matrix.data).sum(axis=0) / np.square(unit).sum(axis=0)
        self.used = replace(self.used, gain=float(self.begun.mean()))

    def run(self, seconds: float) -> Procedure[TrackResult]:
        """Close the loop, track, open the loop."""
        bench, result = self.bench, self.result
        prepare_sensor(bench)
        bench.dm.flatten()
        next_frame(bench)
        lost, result.began_ns = bench.wfs.status().lost, bench.wfs.now_ns()
        science = bench.science if self.psf is not None else None
        if science is not None:
            science.stop()
        slopes_of = extractor(bench, self.grid)
        loop = RunningLoop(bench, self.used.matrix.m2c, slopes_of, self.control, science=science is not None)
        report = Reporter("tracking", math.ceil(seconds / STEP_S), "second")
        with ThreadPoolExecutor(1, thread_name_prefix="live registration") as pool:
            try:
                yield from self._track(loop, report, pool)
            except Aborted:
                result.partial = True
            except CalibrationError as error:
                result.alarms.append(Alarm(self._now(), "dark", str(error)))
                result.stable = False
            finally:
                bench.dm.flatten()
                if science is not None:
                    science.stop()
            self._take_up(loop, running=False)
        result.frames, result.lost_frames = loop.record.frames, bench.wfs.status().lost - lost
        result.rate_hz = loop.record.frames / max(self._now(), 1e-9)
        return result

    def _track(self, loop: RunningLoop, report: Reporter, pool: ThreadPoolExecutor) -> Procedure[None]:
        """Second after second; the answer of each is taken up at the end of the next."""
        motion = Motion(self.grid.n_slopes)
        rate = self.bench.wfs.settings.frame_rate_hz
        yield from self._passed(loop.run(max(1, round(_CLOSING_S * rate))), report, 0)
        watching = [lambda *frame: motion.add(frame[1])]
        yield from self._passed(loop.run(max(2, round(_MOTION_S * rate)), observe=watching), report, 0)
        ready = pool.submit(self.prepare, motion)
        while not (self.bench.simulated or ready.done()):
            yield from self._passed(loop.run(self.frames), report, 0)
        ready.result()
        for second in range(report.total):
            frames, shortened = loop.record.frames, loop.record.shortened
            steps = loop.run(self.frames, inject=self._poke, observe=[self.tape])
            yield from self._passed(steps, report, second)
            if loop.record.diverged or self.runaway(loop.record, frames, shortened):
                self._lose()
                return
            # A twin's clock stands still meanwhile; at a real bench the loop does not wait.
            if self.pending is not None and (self.pending.done() or self.bench.simulated):
                self._take_up(loop)
            if self.pending is None:
                images = self._images(loop)
                self.pending = pool.submit(self._look, *self.tape.handover(), self._now(), images)

    def _passed(self, steps: Procedure[object], report: Reporter, done: int) -> Iterator[Progress]:
        """Progress of the whole in place of a stretch's own, with what the last look said."""
        for step in steps:
            arrays, self.arrays = self.arrays, {}
            yield report(done, {**step.arrays, **arrays}, **step.metrics, **self.metrics)

    def _poke(self) -> NDArray[np.float64]:
        return self.amplitude * self.bench.rng.uniform(-1.0, 1.0, self.amplitude.size)

    def _now(self) -> float:
        """Seconds since the loop was closed."""
        return (self.bench.wfs.now_ns() - self.result.began_ns) * 1e-9

    def _images(self, loop: RunningLoop) -> FrameStack | None:
        """The science frames since the last ones, every few updates."""
        if self.psf is None or self.updates % _STREHL_EVERY or loop.record.science.count < LEAST:
            return None
        images, loop.record.science = loop.record.science, FrameStack()
        return images

    def _look(self, data: Telemetry, start: int, seconds: float, images: FrameStack | None) -> Answer | None:
        """What a block of frames says, if there are enough of them; in the thread."""
        try:
            live = self.live.update(data, start)
        except TooFewFrames:
            return None
        made = synthesise(self.bench, self.grid, live.registration, self.used.matrix.m2c)
        worth = self.bench.config.tracking.worth
        found = propose(made.matrix, self.model, live, self.used, self.dropped, seconds, worth)
        return Answer(seconds, live, made, found, self._strehl(images))

    def _strehl(self, images: FrameStack | None) -> tuple[float, float]:
        """Strehl ratio and its error; NaN without images, or when they are off the middle of the camera."""
        if images is None or self.psf is None:
            return math.nan, math.nan
        try:
            peak = strehl(images.images(), self.psf).peak
        except CalibrationError as error:
            log.warning("no Strehl ratio: %s", error)
            return math.nan, math.nan
        return peak.value, peak.sigma

    def _take_up(self, loop: RunningLoop, running: bool = True) -> None:
        """Book the answer that is waited for, raise alarms, exchange the matrix if the loop still runs."""
        answer = None if self.pending is None else self.pending.result()
        self.pending = None
        if answer is None:
            return
        self.updates += 1
        alarms = self.watch.look(answer.live, answer.seconds)
        self.result.alarms += alarms
        wanted = answer.proposal.worthwhile and self.watch.calm and self.updates >= _FIRST_EXCHANGE
        self._book(answer, loop, wanted and self._exchange(answer.proposal, running))
        if any(alarm.kind == "jump" for alarm in alarms):
            self.live.restart()

    def _exchange(self, proposal: Proposal, running: bool) -> bool:
        """Take a matrix into use, or only propose it."""
        limit = self.bench.config.tracking.limit
        within = running and self.exchange and proposal.evidence.mismatch <= limit
        self.result.exchanges.append(taken(proposal) if within else proposal.evidence)
        if within:
            self.control.set_reconstructor(proposal.to_use.reconstructor)
            self.used = proposal.to_use
        return within

    def _book(self, answer: Answer, loop: RunningLoop, exchanged: bool) -> None:
        """Append a row, and keep the latest matrix."""
        result, live, proposal = self.result, answer.live, answer.proposal
        relative, relative_sigma = live.gains / self.begun, live.gains_sigma / self.begun
        result.optical_gain, result.optical_gain_sigma = relative, relative_sigma
        result.latest = replace(answer.made, matrix=proposal.to_use.matrix, response=live.response)
        residual = np.asarray(loop.record.residual[self.residual_at :])
        self.residual_at = len(loop.record.residual)
        row = row_of(answer, relative, relative_sigma, residual, exchanged)
        result.add(**row)
        self.metrics = {name: row[name] for name in SHOWN}
        self.arrays = to_show(result)

    def _lose(self) -> None:
        """The loop diverged."""
        self.result.stable = False
        self.result.alarms.append(
            Alarm(self._now(), "diverged", "the loop diverged and was opened; calibrate anew")
        )
