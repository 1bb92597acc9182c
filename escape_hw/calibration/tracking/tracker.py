"""The tracker: closed loop with small pokes, live registration, and exchange of the reconstructor."""

from __future__ import annotations

import math
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.procedure import Procedure, Progress, Reporter
from escape_hw.api.registration import PARAMETERS, TO_STREAM_UNITS
from escape_hw.api.results import CalibrationResult, Estimate, RegistrationEstimate, TemporalResponse
from escape_hw.api.sensor import SensorGeometry
from escape_hw.api.tracking import DRIFT, Alarm, TrackResult
from escape_hw.bench import Bench
from escape_hw.calibration.acquisition.aligned_telemetry import AlignedTelemetry, TelemetryBuffer
from escape_hw.calibration.acquisition.pokes import RandomPokes, compute_poke_amplitudes
from escape_hw.calibration.acquisition.slope_statistics import SlopeStatistics
from escape_hw.calibration.loop.control import build_integrator, invert_matrix
from escape_hw.calibration.loop.divergence import BlockResidualMonitor
from escape_hw.calibration.loop.performance import peak_strehl
from escape_hw.calibration.loop.runner import SETTLING_S, RunningLoop
from escape_hw.calibration.optical_gain.smoothing import COEFFICIENT_SIGMA
from escape_hw.calibration.sprint.fit import sprint, sprint_options_from_config
from escape_hw.calibration.sprint.synthetic_matrix import compute_fitted_matrix, synthesise_calibration
from escape_hw.calibration.tracking.alarms import AlarmMonitor
from escape_hw.calibration.tracking.exchange import (
    ActiveReconstructor,
    ExchangeProposal,
    propose_exchange,
)
from escape_hw.calibration.tracking.live_registration import (
    LiveEstimate,
    LiveRegistration,
    count_history_rows,
)
from escape_hw.errors import Aborted, CalibrationError, ConfigError, TooFewFrames
from escape_hw.pipeline.psf.frame_stack import FrameStack
from escape_hw.pipeline.statistics import MIN_SAMPLES, root_mean_square

#: Seconds between two updates of the registration.
STEP_S = 1.0
#: Seconds after settling in which the motion of the slopes is measured.
_MOTION_S = 1.0
#: Updates before the first exchange, in which the memory fills.
_FIRST_EXCHANGE = 3
#: Updates between two Strehl ratios.
_STREHL_EVERY = 5
#: Columns of the last update in progress reports.
PROGRESS_COLUMNS = ("shift_x", "shift_x_sigma", "shift_y", "shift_y_sigma", "rotation", "rotation_sigma",
         "optical_gain", "optical_gain_sigma", "misfit")  # fmt: skip
#: Number of recent updates in the progress arrays.
_MAX_PLOTTED_UPDATES = 4096


def track(
    bench: Bench,
    matrix: InteractionMatrix,
    grid: SensorGeometry,
    *,
    seconds: float = 60.0,
    registration: RegistrationEstimate | None = None,
    response: TemporalResponse | None = None,
    poke: float | None = None,
    forgetting_time_s: float | None = None,
    exchange: bool = True,
    gain: float | None = None,
    model_psf: NDArray[np.float32] | None = None,
) -> Procedure[TrackResult]:
    """Run the loop and track the registration and the optical gains.

    Parameters
    ----------
    registration
        The registration of the matrix; fitted to the matrix by default.
    poke
        Pokes are uniform in +-poke on every mode, rms surface as fraction of full stroke; as configured.
    forgetting_time_s
        Time in which the weight of a frame falls to ``1 / e``; as configured by default.
    exchange
        Whether a new matrix may be used without confirmation, within the configured limits; false: new
        matrices are only proposed.
    gain
        Gain of the integrator; as configured by default.
    model_psf
        PSF without turbulence; with it the Strehl ratio is measured as well.

    Returns
    -------
    TrackResult
        ``partial`` when stopped early; ``stable`` false when the loop diverged or the sensor went dark.

    Raises
    ------
    ConfigError
        A duration, poke or memory out of range; nothing moved.
    IncompatibleProduct, CalibrationError
        The matrix does not fit the bench, cannot be inverted, or has no registration; nothing moved.
    """
    t = bench.config.tracking
    poke = t.poke if poke is None else poke
    memory = t.forgetting_time_s if forgetting_time_s is None else forgetting_time_s
    if not (STEP_S <= seconds < math.inf and 0 < poke < math.inf and 0 < memory < math.inf):
        raise ConfigError(
            f"seconds is {seconds}, poke {poke} and forgetting_time_s {memory}; the first must be at least "
            f"{STEP_S:g}, the others positive"
        )
    tracker = _Tracker(bench, matrix, grid, registration, response, poke, memory, exchange, gain, model_psf)
    return (yield from tracker.run(seconds))


@dataclass(frozen=True, slots=True, eq=False)
class TrackerUpdate:
    """Result of one update of the tracker."""

    #: Time of the last frame, since the loop was closed.
    seconds: float
    live: LiveEstimate
    #: Pseudo-synthetic matrix at the live registration.
    synthetic: CalibrationResult
    #: That matrix at the live gains, compared with the one in use.
    proposal: ExchangeProposal
    #: NaN without one.
    strehl: Estimate


class _Tracker:
    """A run of the tracker: the loop in the calling thread, the updates in a worker thread."""

    def __init__(
        self,
        bench: Bench,
        matrix: InteractionMatrix,
        grid: SensorGeometry,
        registration: RegistrationEstimate | None,
        response: TemporalResponse | None,
        poke: float,
        forgetting_time_s: float,
        exchange: bool,
        gain: float | None,
        model_psf: NDArray[np.float32] | None,
    ) -> None:
        c, t = bench.config.calibration, bench.config.tracking
        self.bench, self.grid, self.exchange, self.psf = bench, grid, exchange, model_psf
        self.control = build_integrator(bench, matrix, grid, gain=gain)
        start = registration or sprint(matrix, bench.model(grid), **sprint_options_from_config(c))
        if not start.converged:
            raise CalibrationError(
                f"the matrix has no registration to start from: {'; '.join(start.warnings)}"
            )
        amplitude = compute_poke_amplitudes(bench, matrix.m2c, poke)
        self.pokes = RandomPokes(amplitude, bench.rng)
        self.response, self.memory_s = response, forgetting_time_s
        self.dropped = bench.config.loop.dropped_modes
        self.in_use = ActiveReconstructor(matrix, invert_matrix(matrix, self.dropped), start, 1.0)
        self.start = start.registration
        self.alarm_monitor = AlarmMonitor(start.registration, t.max_shift, response)
        self.result = TrackResult(poke=float(amplitude.max()))
        self.frames = max(1, round(STEP_S * bench.wfs.settings.frame_rate_hz))
        history = count_history_rows(c.whiten_order, c.lags)
        self.buffer = TelemetryBuffer(grid.n_slopes, matrix.n_modes, self.frames, history)
        self.updates, self.residual_at = 0, 0
        self.pending_update: Future[TrackerUpdate | None] | None = None
        self.metrics: dict[str, float] = {}
        self.arrays: dict[str, NDArray[np.float32]] = {}
        self.divergence_monitor = BlockResidualMonitor(bench.config.server)

    def prepare(self, slope_statistics: SlopeStatistics) -> None:
        """Build the model for the closed loop and start the live registration; in the worker thread.

        The response of the sensor depends on the motion of the slopes, which is smaller in closed loop than
        while the matrix was measured.
        """
        bench, matrix, start = self.bench, self.in_use.matrix, self.in_use.registration
        c = bench.config.calibration
        self.grid = slope_statistics.annotate_geometry(self.grid, closed=True)
        self.model = bench.model(self.grid)
        self.live = LiveRegistration(
            matrix, self.model, start, order=c.whiten_order, lags=c.lags,
            memory_s=self.memory_s, response=self.response,
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
        """Run the loop second by second; the update of each second is used at the end of the next."""
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
            steps = loop.run(self.frames, inject=self.pokes, observe=[self.buffer])
            yield from self._forward_progress(steps, report, second)
            record = loop.record
            if record.diverged or self.divergence_monitor(
                record.residual[frames:], record.shortened - shortened
            ):
                self.result.stable = False
                text = "the loop diverged and was opened; calibrate again"
                self.result.alarms.append(Alarm(self._elapsed_s(), "diverged", text))
                return
            # The loop of a real bench does not wait for the update; the clock of a twin stands still.
            if self.pending_update is not None and (self.pending_update.done() or self.bench.simulated):
                self._handle_update(loop)
            if self.pending_update is None:
                images = self._take_images(loop)
                self.pending_update = pool.submit(
                    self._update_registration, *self.buffer.take_block(), self._elapsed_s(), images
                )

    def _forward_progress(self, steps: Procedure[object], report: Reporter, done: int) -> Iterator[Progress]:
        """Progress of the whole run, with the numbers of the last update."""
        for step in steps:
            arrays, self.arrays = self.arrays, {}
            yield report(done, {**step.arrays, **arrays}, **step.metrics, **self.metrics)

    def _elapsed_s(self) -> float:
        """Seconds since the loop was closed."""
        return (self.bench.wfs.now_ns() - self.result.start_ns) * 1e-9

    def _take_images(self, loop: RunningLoop) -> FrameStack | None:
        """The science frames since the last Strehl ratio; ``None`` unless one is due."""
        if self.psf is None or self.updates % _STREHL_EVERY or loop.record.science.count < MIN_SAMPLES:
            return None
        images, loop.record.science = loop.record.science, FrameStack()
        return images

    def _update_registration(
        self, data: AlignedTelemetry, start: int, seconds: float, images: FrameStack | None
    ) -> TrackerUpdate | None:
        """Update for a block of frames, ``None`` if there are too few; in the worker thread."""
        try:
            new_s = (len(data.rows) - start) / self.bench.wfs.settings.frame_rate_hz
            live = self.live.update(data, start, new_s)
        except TooFewFrames:
            return None
        synthetic = synthesise_calibration(
            self.bench, self.grid, live.registration, self.in_use.matrix.m2c, live.fitted
        )
        proposal = propose_exchange(
            synthetic.matrix, live, self.in_use, self.dropped, seconds,
            self.bench.config.tracking.exchange_threshold,
        )  # fmt: skip
        ratio = None if images is None or self.psf is None else peak_strehl(images, self.psf)
        return TrackerUpdate(seconds, live, synthetic, proposal, ratio or Estimate(math.nan, math.nan))

    def _handle_update(self, loop: RunningLoop, running: bool = True) -> None:
        """Wait for the pending update, record it, raise alarms, and exchange the matrix if the loop runs."""
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
        """Use a proposed matrix if that is allowed, and record the proposal; whether it is in use."""
        limit = self.bench.config.tracking.exchange_limit
        allowed = running and self.exchange and proposal.evidence.mismatch <= limit
        self.result.exchanges.append(replace(proposal.evidence, accepted=allowed))
        if allowed:
            self.control.set_reconstructor(proposal.candidate.reconstructor)
            self.in_use = proposal.candidate
        return allowed

    def _append_row(self, update: TrackerUpdate, loop: RunningLoop, exchanged: bool) -> None:
        """Append a row to the result and store the latest matrix."""
        result, live, proposal = self.result, update.live, update.proposal
        relative, relative_sigma = live.gains / self.initial_gains, live.gains_sigma / self.initial_gains
        result.optical_gain, result.optical_gain_sigma = relative, relative_sigma
        result.latest = replace(update.synthetic, matrix=proposal.candidate.matrix, response=live.response)
        residual = np.asarray(loop.record.residual[self.residual_at :])
        self.residual_at = len(loop.record.residual)
        row = build_row(update, relative, relative_sigma, residual, exchanged)
        result.add(**row)
        # Of an actuator at the edge of the pupil, since the start.
        radius = math.sqrt(self.grid.n_valid / math.pi)
        drift = live.registration.registration.largest_displacement(self.start, radius)
        self.metrics = {**{name: row[name] for name in PROGRESS_COLUMNS}, DRIFT: drift}
        self.arrays = progress_arrays(result)


def build_row(
    update: TrackerUpdate,
    gains: NDArray[np.float64],
    gains_sigma: NDArray[np.float64],
    residual: NDArray[np.float64],
    exchanged: bool,
) -> dict[str, float]:
    """Row of the table for an update.

    ``gains (n_modes,)`` are relative to the matrix at the start; ``residual (n,)`` is that of the frames
    since the last row, in nm.
    """
    live, parameters = update.live, update.live.registration.parameters()
    return {
        "seconds": update.seconds,
        **{name: one.value for name, one in parameters.items()},
        **{f"{name}_sigma": one.sigma for name, one in parameters.items()},
        "optical_gain": float(gains.mean()), "optical_gain_sigma": float(gains_sigma.mean()),
        "misfit": live.misfit, "innovation": live.innovation, "noise": live.noise,
        "mismatch": update.proposal.evidence.mismatch,
        "residual_nm": root_mean_square(residual),
        "strehl": update.strehl.value, "strehl_sigma": update.strehl.sigma, "exchanged": float(exchanged),
    }  # fmt: skip


def progress_arrays(result: TrackResult) -> dict[str, NDArray[np.float32]]:
    """History of the registration, and present gains, in the units of streams."""
    names = ("seconds", *PARAMETERS, *(f"{name}_sigma" for name in PARAMETERS))
    history = np.array([result.rows[name][-_MAX_PLOTTED_UPDATES:] for name in names]).T
    history[:, 1:] *= np.tile(TO_STREAM_UNITS, 2)
    arrays = {
        "registration_track": history,
        "gains": result.optical_gain,
        "gains_sigma": result.optical_gain_sigma,
    }
    return {name: array.astype(np.float32) for name, array in arrays.items()}
