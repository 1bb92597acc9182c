"""The tracker: closed loop with small pokes, live registration once per second, and exchange of the reconstructor."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.procedure import Procedure, Progress, Reporter
from escape_hw.api.registration import PARAMETERS, TO_STREAM_UNITS
from escape_hw.api.results import CalibrationResult, RegistrationEstimate, TemporalResponse
from escape_hw.api.sensor import SensorGeometry
from escape_hw.api.tracking import Alarm, TrackResult
from escape_hw.bench import Bench
from escape_hw.calibration.acquisition.pokes import compute_poke_amplitudes
from escape_hw.calibration.acquisition.slope_statistics import SlopeStatistics
from escape_hw.calibration.acquisition.telemetry import AlignedTelemetry, TelemetryBuffer
from escape_hw.calibration.loop.control import build_integrator
from escape_hw.calibration.loop.divergence import BlockResidualMonitor, DivergenceLimits
from escape_hw.calibration.loop.runner import SETTLING_S, RunningLoop
from escape_hw.calibration.optical_gain.smoothing import COEFFICIENT_SIGMA
from escape_hw.calibration.sprint.fit import sprint, sprint_options_from_config
from escape_hw.calibration.sprint.synthetic_matrix import compute_fitted_matrix, synthesise_calibration
from escape_hw.calibration.tracking.alarms import AlarmMonitor
from escape_hw.calibration.tracking.exchange import (
    ActiveReconstructor,
    ExchangeProposal,
    accept_proposal,
    invert_matrix,
    propose_exchange,
)
from escape_hw.calibration.tracking.live_registration import LiveEstimate, LiveRegistration
from escape_hw.errors import Aborted, CalibrationError, ConfigError, TooFewFrames
from escape_hw.pipeline.psf.frame_stack import FrameStack
from escape_hw.pipeline.psf.strehl import strehl
from escape_hw.pipeline.statistics import MIN_SAMPLES

#: What progress reports tell of the last look.
PROGRESS_COLUMNS = ("shift_x", "shift_x_sigma", "shift_y", "shift_y_sigma", "rotation", "rotation_sigma",
         "optical_gain", "optical_gain_sigma", "misfit")  # fmt: skip
#: Updates that a picture of the registration's course shows.
_MAX_PLOTTED_UPDATES = 4096


@dataclass(frozen=True, slots=True, eq=False)
class TrackerUpdate:
    """What the frames up to a moment say, the matrix that follows, and the latest Strehl ratio.

    Parameters
    ----------
    seconds
        The moment, since the loop was closed.
    live
        The live registration.
    made
        The pseudo-synthetic matrix of it.
    proposal
        That matrix, scaled to the live gains, held against the one in use.
    ratio
        Strehl ratio and its error; NaN where there is none.
    """

    seconds: float
    live: LiveEstimate
    synthetic: CalibrationResult
    proposal: ExchangeProposal
    strehl: tuple[float, float]


def build_row(
    update: TrackerUpdate,
    gains: NDArray[np.float64],
    gains_sigma: NDArray[np.float64],
    residual: NDArray[np.float64],
    exchanged: bool,
) -> dict[str, float]:
    """An answer as a row of the track's table.

    Parameters
    ----------
    answer
        What a look said.
    gains, gains_sigma
        Gain of every mode beside the matrix that tracking began with ``(n_modes,)``, and its error.
    residual
        Residuals of the loop's frames since the last row, in nm ``(n,)``.
    exchanged
        Whether its matrix was taken into use.
    """
    live, parameters = update.live, update.live.registration.measured()
    return {
        "seconds": update.seconds,
        **{name: one.value for name, one in parameters.items()},
        **{f"{name}_sigma": one.sigma for name, one in parameters.items()},
        "optical_gain": float(gains.mean()), "optical_gain_sigma": float(gains_sigma.mean()),
        "misfit": live.misfit, "surprise": live.surprise, "noise": live.noise,
        "mismatch": update.proposal.evidence.mismatch,
        "residual_nm": float(np.sqrt(np.mean(np.square(residual)))) if residual.size else math.nan,
        "strehl": update.strehl[0], "strehl_sigma": update.strehl[1], "exchanged": float(exchanged),
    }  # fmt: skip


def progress_arrays(result: TrackResult) -> dict[str, NDArray[np.float32]]:
    """Course of the registration and present gains, in the units of streams."""
    names = ("seconds", *PARAMETERS, *(f"{name}_sigma" for name in PARAMETERS))
    history = np.array([result.rows[name][-_MAX_PLOTTED_UPDATES:] for name in names]).T
    history[:, 1:] *= np.tile(TO_STREAM_UNITS, 2)
    arrays = {
        "registration_track": history,
        "gains": result.optical_gain,
        "gains_sigma": result.optical_gain_sigma,
    }
    return {name: array.astype(np.float32) for name, array in arrays.items()}


log = logging.getLogger(__name__)

#: Seconds between two looks at the registration.
STEP_S = 1.0
#: Seconds after settling in which the slope statistics are measured.
_MOTION_S = 1.0
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
        self.control = build_integrator(bench, matrix, grid, gain=gain)
        start = registration or sprint(matrix, bench.model(grid), **sprint_options_from_config(c))
        if not start.converged:
            raise CalibrationError(f"no registration to begin with: {'; '.join(start.warnings)}")
        self.amplitude = compute_poke_amplitudes(bench, matrix.m2c, poke)
        self.response, self.memory = response, memory_s / STEP_S
        self.dropped = bench.config.loop.dropped_modes
        self.in_use = ActiveReconstructor(matrix, invert_matrix(matrix, self.dropped), start, 1.0)
        self.alarm_monitor = AlarmMonitor(start.registration, t.max_shift, response)
        self.result = TrackResult(poke=poke)
        self.frames = max(1, round(STEP_S * bench.wfs.settings.frame_rate_hz))
        self.buffer = TelemetryBuffer(grid.n_slopes, matrix.n_modes, self.frames, 2 * c.whiten_order + c.lags)
        self.updates, self.residual_at = 0, 0
        self.pending_update: Future[TrackerUpdate | None] | None = None
        self.metrics: dict[str, float] = {}
        self.arrays: dict[str, NDArray[np.float32]] = {}
        self.divergence_monitor = BlockResidualMonitor(DivergenceLimits.from_config(bench.config))

    def prepare(self, slope_statistics: SlopeStatistics) -> None:
        """Build the model for the light that the closed loop leaves, and start on it; in the thread.

        How a sensor answers depends on how much its light moves, and in closed loop that is less than
        while the matrix was measured.
        """
        bench, matrix, start = self.bench, self.in_use.matrix, self.in_use.registration
        c = bench.config.calibration
        self.grid = slope_statistics.annotate_geometry(self.grid, closed=True)
        self.model = bench.model(self.grid)
        self.live = LiveRegistration(
            matrix, self.model, start, order=c.whiten_order, lags=c.lags,
            memory=self.memory, step_s=STEP_S, response=self.response,
            n_curve_coefficients=len(COEFFICIENT_SIGMA) if bench.config.sensor.kind == "pyramid" else 0,
        )  # fmt: skip
        unit = compute_fitted_matrix(self.model, start.registration, start, matrix.m2c)
        self.initial_gains = (unit * matrix.data).sum(axis=0) / np.square(unit).sum(axis=0)
        self.in_use = replace(self.in_use, gain=float(self.initial_gains.mean()))

    def run(self, seconds: float) -> Procedure[TrackResult]:
        """Close the loop, track, open the loop."""
        bench, result = self.bench, self.result
        loop = RunningLoop.prepare(
            bench, self.in_use.matrix, self.grid, self.control, science=self.psf is not None
        )
        report = Reporter("tracking", math.ceil(seconds / STEP_S), "second")
        with ThreadPoolExecutor(1, thread_name_prefix="live registration") as pool:
            with loop.closed():
                result.start_ns = loop.closed_at_ns
                try:
                    yield from self._track(loop, report, pool)
                except Aborted:
                    result.partial = True
                except CalibrationError as error:
                    result.alarms.append(Alarm(self._elapsed_s(), "dark", str(error)))
                    result.stable = False
            self._handle_update(loop, running=False)
        result.frames, result.lost_frames = loop.record.frames, loop.lost_frames
        result.rate_hz = loop.record.frames / max(self._elapsed_s(), 1e-9)
        return result

    def _track(self, loop: RunningLoop, report: Reporter, pool: ThreadPoolExecutor) -> Procedure[None]:
        """Second after second; the answer of each is taken up at the end of the next."""
        slope_statistics = SlopeStatistics(self.grid.n_slopes)
        rate = self.bench.wfs.settings.frame_rate_hz
        yield from self._forward_progress(loop.run(max(1, round(SETTLING_S * rate))), report, 0)
        observers = [lambda *frame: slope_statistics.add(frame[1])]
        yield from self._forward_progress(
            loop.run(max(2, round(_MOTION_S * rate)), observe=observers), report, 0
        )
        ready = pool.submit(self.prepare, slope_statistics)
        while not (self.bench.simulated or ready.done()):
            yield from self._forward_progress(loop.run(self.frames), report, 0)
        ready.result()
        for second in range(report.total):
            frames, shortened = loop.record.frames, loop.record.shortened
            steps = loop.run(self.frames, inject=self._draw_poke, observe=[self.buffer])
            yield from self._forward_progress(steps, report, second)
            record = loop.record
            if record.diverged or self.divergence_monitor(
                record.residual[frames:], record.shortened - shortened
            ):
                self._report_divergence()
                return
            # A twin's clock stands still meanwhile; at a real bench the loop does not wait.
            if self.pending_update is not None and (self.pending_update.done() or self.bench.simulated):
                self._handle_update(loop)
            if self.pending_update is None:
                images = self._take_images(loop)
                self.pending_update = pool.submit(
                    self._update_registration, *self.buffer.take_block(), self._elapsed_s(), images
                )

    def _forward_progress(self, steps: Procedure[object], report: Reporter, done: int) -> Iterator[Progress]:
        """Progress of the whole in place of a stretch's own, with what the last look said."""
        for step in steps:
            arrays, self.arrays = self.arrays, {}
            yield report(done, {**step.arrays, **arrays}, **step.metrics, **self.metrics)

    def _draw_poke(self) -> NDArray[np.float64]:
        return self.amplitude * self.bench.rng.uniform(-1.0, 1.0, self.amplitude.size)

    def _elapsed_s(self) -> float:
        """Seconds since the loop was closed."""
        return (self.bench.wfs.now_ns() - self.result.start_ns) * 1e-9

    def _take_images(self, loop: RunningLoop) -> FrameStack | None:
        """The science frames since the last ones, every few updates."""
        if self.psf is None or self.updates % _STREHL_EVERY or loop.record.science.count < MIN_SAMPLES:
            return None
        images, loop.record.science = loop.record.science, FrameStack()
        return images

    def _update_registration(
        self, data: AlignedTelemetry, start: int, seconds: float, images: FrameStack | None
    ) -> TrackerUpdate | None:
        """What a block of frames says, if there are enough of them; in the thread."""
        try:
            live = self.live.update(data, start)
        except TooFewFrames:
            return None
        synthetic = synthesise_calibration(self.bench, self.grid, live.registration, self.in_use.matrix.m2c)
        worth = self.bench.config.tracking.exchange_threshold
        proposal = propose_exchange(
            synthetic.matrix, self.model, live, self.in_use, self.dropped, seconds, worth
        )
        return TrackerUpdate(seconds, live, synthetic, proposal, self._strehl(images))

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

    def _handle_update(self, loop: RunningLoop, running: bool = True) -> None:
        """Book the answer that is waited for, raise alarms, exchange the matrix if the loop still runs."""
        update = None if self.pending_update is None else self.pending_update.result()
        self.pending_update = None
        if update is None:
            return
        self.updates += 1
        alarms = self.alarm_monitor.check(update.live, update.seconds)
        self.result.alarms += alarms
        should_exchange = (
            update.proposal.exceeds_threshold
            and self.alarm_monitor.is_quiet
            and self.updates >= _FIRST_EXCHANGE
        )
        self._append_row(update, loop, should_exchange and self._exchange_matrix(update.proposal, running))
        if any(alarm.kind == "jump" for alarm in alarms):
            self.live.restart()

    def _exchange_matrix(self, proposal: ExchangeProposal, running: bool) -> bool:
        """Take a matrix into use, or only propose it."""
        limit = self.bench.config.tracking.exchange_limit
        allowed = running and self.exchange and proposal.evidence.mismatch <= limit
        self.result.exchanges.append(accept_proposal(proposal) if allowed else proposal.evidence)
        if allowed:
            self.control.set_reconstructor(proposal.candidate.reconstructor)
            self.in_use = proposal.candidate
        return allowed

    def _append_row(self, update: TrackerUpdate, loop: RunningLoop, exchanged: bool) -> None:
        """Append a row, and keep the latest matrix."""
        result, live, proposal = self.result, update.live, update.proposal
        relative, relative_sigma = live.gains / self.initial_gains, live.gains_sigma / self.initial_gains
        result.optical_gain, result.optical_gain_sigma = relative, relative_sigma
        result.latest = replace(update.synthetic, matrix=proposal.candidate.matrix, response=live.response)
        residual = np.asarray(loop.record.residual[self.residual_at :])
        self.residual_at = len(loop.record.residual)
        row = build_row(update, relative, relative_sigma, residual, exchanged)
        result.add(**row)
        self.metrics = {name: row[name] for name in PROGRESS_COLUMNS}
        self.arrays = progress_arrays(result)

    def _report_divergence(self) -> None:
        """The loop diverged."""
        self.result.stable = False
        self.result.alarms.append(
            Alarm(self._elapsed_s(), "diverged", "the loop diverged and was opened; calibrate anew")
        )
