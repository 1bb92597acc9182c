"""Closed loop for an operator: runs until it is opened, with settings that can change, a running Strehl ratio and divergence checks."""

from __future__ import annotations

import logging
import math
import time
from array import array
from collections.abc import Mapping
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.procedure import Procedure, Progress, Reporter
from escape_hw.api.results import Estimate
from escape_hw.bench import Bench
from escape_hw.calibration.acquisition.frames import next_frame
from escape_hw.calibration.acquisition.sensor_setup import prepare_sensor
from escape_hw.calibration.loop.control import LoopChange, LoopControl, LoopSettings
from escape_hw.calibration.loop.divergence import DivergenceMonitor
from escape_hw.calibration.loop.runner import RunningLoop
from escape_hw.errors import Aborted, CalibrationError, CommandRejected, FrameTimeout
from escape_hw.pipeline.psf.frame_stack import FrameStack
from escape_hw.pipeline.psf.strehl import strehl
from escape_hw.pipeline.statistics import MIN_SAMPLES
from escape_hw.streams.realtime import PRIORITY, isolated_cpus, realtime_thread
from escape_hw.streams.timing import TimingSummary

log = logging.getLogger(__name__)


class RunningStrehl:
    """Judges the science frames since the last time, in another thread.

    Parameters
    ----------
    model
        PSF without turbulence ``(rows, columns)``.
    """

    def __init__(self, model: NDArray[np.float32]) -> None:
        self._model = model
        self._pending: Future[Estimate | None] | None = None
        self._value = Estimate(math.nan, math.nan)

    def take(self, images: FrameStack, pool: Executor) -> bool:
        """Judge these images, if they are enough and the last ones are judged; whether they were taken."""
        if self._pending is not None:
            if not self._pending.done():
                return False
            self._value, self._pending = self._pending.result() or self._value, None
        if images.count < MIN_SAMPLES:
            return False
        self._pending = pool.submit(self._evaluate, images)
        return True

    def metrics(self) -> dict[str, float]:
        """The latest ratio by its peak, and its standard error; NaN before the first."""
        return {"strehl": self._value.value, "strehl_sigma": self._value.sigma}

    def _evaluate(self, images: FrameStack) -> Estimate | None:
        try:
            return strehl(images.images(), self._model).peak
        except CalibrationError as error:
            log.warning("no Strehl ratio: %s", error)
            return None


#: Seconds between two looks at orders, watchdogs and the science camera.
_CHECK_PERIOD_S = 0.1
#: Seconds between two counts for the display.
_METRICS_PERIOD_S = 0.25
#: Time-outs in a row that open the loop.
_MAX_TIMEOUTS = 5
#: Frames over which what a new reconstructor does not drive any more fades from the mirror.
_FADE_FRAMES = 100
#: Residuals kept for the display.
_N_RESIDUALS = 500


@dataclass(frozen=True, slots=True, eq=False)
class LoopSummary:
    """How a loop ended that ran until it was told to open.

    Parameters
    ----------
    fault
        Why it was opened although nobody asked; empty when somebody did.
    settings
        The last in force.
    frames, lost_frames, timeouts
        Answered, lost by the camera, and waited for in vain.
    timing
        Since it was closed.
    """

    fault: str
    settings: LoopSettings
    frames: int
    lost_frames: int
    timeouts: int
    timing: TimingSummary


def run_until_opened(
    bench: Bench, loop_control: LoopControl, *, model_psf: NDArray[np.float32] | None = None
) -> Procedure[LoopSummary]:
    """Close the loop and keep it closed until ``loop_control`` say to open it, or something is wrong.

    The mirror ends flat in any case. On devices that are no twins the loop's thread asks for real-time
    priority, and the log says what the system refused.

    The procedure reports without an end: its ``total`` is 0. Metrics:
    ``residual_nm``, ``gain``, ``leak``, ``dropped_modes``, ``clipped`` (share of the actuators), ``lost``,
    ``latency_p50``, ``latency_p99``, ``latency_max``, ``jitter_p99`` (microseconds, last second), and with
    a model PSF ``strehl`` and ``strehl_sigma``. Arrays: ``residual``, and once a second
    ``latency_histogram``, see :meth:`~escape_hw.streams.timing.LoopTiming.histograms`.

    Parameters
    ----------
    bench
        An open bench.
    orders
        Matrix and settings to begin with; asked for others all the time.
    model_psf
        PSF without turbulence; with it, and with a science camera, the Strehl ratio is followed.

    Returns
    -------
    LoopEnd
        ``fault`` says why the loop was opened when nobody asked: the mirror at its limits, a diverging
        residual, no frames, no light, a command that the guard refused.

    Raises
    ------
    DeviceError
        A device failed or was lost.
    """
    return (yield from _ContinuousLoop(bench, loop_control, model_psf).run())


def _realtime_priority(bench: Bench) -> AbstractContextManager[tuple[str, ...]]:
    """Priority for the loop's thread; a twin computes all the time and would starve the computer."""
    if bench.simulated:
        return realtime_thread(priority=0)
    # Nothing moves a thread from one isolated processor to another, so one is what it gets.
    return realtime_thread(isolated_cpus()[:1] or None)


class _ContinuousLoop:
    """State of a run."""

    def __init__(
        self, bench: Bench, loop_control: LoopControl, model_psf: NDArray[np.float32] | None
    ) -> None:
        first = loop_control.take()
        if first is None:
            raise RuntimeError("orders serve one loop; make new ones")
        self.bench, self.loop_control, self.settings = bench, loop_control, first.settings
        self.strehl = None if model_psf is None or bench.science is None else RunningStrehl(model_psf)
        self.loop = RunningLoop(
            bench, first.settings.calibration.matrix.m2c, first.slopes_of, first.control,
            science=self.strehl is not None,
        )  # fmt: skip
        self.control, self.divergence_monitor = first.control, DivergenceMonitor()
        self.fade_frames_left = 0
        self.fade_step = np.zeros(len(first.undriven))
        self.timeouts = self.consecutive_timeouts = self.lost_before = 0
        self.metrics: dict[str, float] = {}
        self.arrays: dict[str, NDArray[np.float32]] = {}
        self.metrics_at = self.histogram_at = -math.inf
        self.clipped, self.frames_counted = bench.dm.clipped_count, 0

    def run(self) -> Procedure[LoopSummary]:
        """Close, keep, open."""
        bench, fault = self.bench, ""
        prepare_sensor(bench)
        bench.dm.flatten()
        next_frame(bench)
        self.lost_before = bench.wfs.status().lost
        if self.strehl is not None and bench.science is not None:
            bench.science.stop()
        stretch = max(1, round(_CHECK_PERIOD_S * bench.wfs.settings.frame_rate_hz))
        report = Reporter("closed loop", 0)
        with (
            ThreadPoolExecutor(1, thread_name_prefix="running Strehl") as pool,
            _realtime_priority(bench) as refusals,
        ):
            self._log_priority(refusals)
            try:
                while not self.loop_control.is_open_requested and not fault:
                    fault = yield from self._run_stretch(stretch, report)
                    self._handle_requests(pool)
            except Aborted:
                log.info("the loop is opened on request")
            finally:
                bench.dm.flatten()
                if self.strehl is not None and bench.science is not None:
                    bench.science.stop()
        if fault:
            log.error("the loop was opened: %s", fault)
        lost = bench.wfs.status().lost - self.lost_before
        frames, timing = self.loop.record.frames, self.loop.timing.since_start()
        return LoopSummary(fault, self.settings, frames, lost, self.timeouts, timing)

    def _log_priority(self, refusals: tuple[str, ...]) -> None:
        if refusals:
            log.warning("frames may be answered late: %s", "; ".join(refusals))
        elif not self.bench.simulated:
            place = ", ".join(map(str, isolated_cpus()[:1])) or "any"
            log.info("real-time priority %d, memory held, processor: %s", PRIORITY, place)

    def _run_stretch(self, frames: int, report: Reporter) -> Procedure[str]:
        """Answer some frames; what is wrong, if anything."""
        loop, before = self.loop, self.loop.record.frames
        observers = (self._fade_undriven,) if self.fade_frames_left else ()
        fault = ""
        try:
            for step in loop.run(frames, observe=observers, report=report):
                yield self._complete_progress(step)
        except FrameTimeout as error:
            self.timeouts += 1
            self.consecutive_timeouts = 1 if loop.record.frames > before else self.consecutive_timeouts + 1
            yield self._complete_progress(report.now({}))
            if self.consecutive_timeouts >= _MAX_TIMEOUTS:
                return f"no frame for {_MAX_TIMEOUTS} time-outs in a row ({error})"
        except CommandRejected as error:
            return f"a command was refused: {error}"
        except CalibrationError as error:
            return str(error)
        if loop.record.diverged:
            fault = (
                "most actuators stood at their limits: lower the gain or drop more modes; if that does not "
                "help, the matrix does not belong to this state of the bench"
            )
        elif self.divergence_monitor(self._residuals_since(before)):
            fault = (
                f"the residual grew {self.divergence_monitor.growth:.2g}-fold: lower the gain, drop more modes, or "
                "measure the matrix again"
            )
        return fault

    def _residuals_since(self, frames: int) -> array[float]:
        residual = self.loop.record.residual
        return residual[len(residual) - (self.loop.record.frames - frames) :]

    def _handle_requests(self, pool: ThreadPoolExecutor) -> None:
        """What is done between two stretches, in less than the time of a frame."""
        record = self.loop.record
        del record.residual[:-_N_RESIDUALS], record.latency[:]
        if (change := self.loop_control.take()) is not None:
            self._apply_change(change)
        if self.strehl is not None:
            if self.strehl.take(record.science, pool):
                record.science = FrameStack()
            self.metrics |= self.strehl.metrics()

    def _apply_change(self, change: LoopChange) -> None:
        """Go on with other settings: the state stays, and what nobody drives any more fades."""
        change.control.set_applied(self.control.state)
        self.control = self.loop.control = change.control
        self.loop.slopes_of, self.settings = change.slopes_of, change.settings
        self.metrics_at = -math.inf
        undriven_state = change.undriven @ (change.undriven.T @ change.control.state)
        self.fade_step, self.fade_frames_left = (
            undriven_state / _FADE_FRAMES,
            _FADE_FRAMES if undriven_state.any() else 0,
        )

    def _fade_undriven(self, *_: object) -> None:
        """Take a share of the fading part off the controller's state; as a loop's observer."""
        if self.fade_frames_left:
            self.fade_frames_left -= 1
            self.control.set_applied(self.control.state - self.fade_step)

    def _complete_progress(self, step: Progress) -> Progress:
        """Progress of a stretch with what is known of the whole."""
        now = time.monotonic()
        if now - self.metrics_at > _METRICS_PERIOD_S:
            self.metrics_at = now
            self._update_metrics()
        arrays: Mapping[str, NDArray[np.float32]] = step.arrays
        if now - self.histogram_at > 1.0:
            self.histogram_at = now
            arrays = {**arrays, "latency_histogram": self.loop.timing.histograms()}
        return replace(
            step, done=self.loop.record.frames, metrics={**self.metrics, **step.metrics}, arrays=arrays
        )

    def _update_metrics(self) -> None:
        """Numbers of the last second."""
        timing, s, bench = self.loop.timing.recent(), self.settings, self.bench
        clipped, frames = bench.dm.clipped_count, self.loop.record.frames
        new, frames_counted = clipped - self.clipped, max(frames - self.frames_counted, 1)
        self.clipped, self.frames_counted = clipped, frames
        self.metrics |= {
            "gain": s.gain, "leak": s.leak, "dropped_modes": float(s.dropped_modes),
            "clipped": new / (frames_counted * bench.dm.info.n_act),
            "lost": float(bench.wfs.status().lost - self.lost_before), "timeouts": float(self.timeouts),
            "latency_p50": timing.p50, "latency_p99": timing.p99, "latency_max": timing.largest,
            "jitter_p99": timing.jitter_p99,
        }  # fmt: skip
