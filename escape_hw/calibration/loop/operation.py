"""Closed loop for an operator: runs until it is opened, with live settings and divergence checks."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Mapping
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.procedure import Procedure, Progress, Reporter
from escape_hw.api.results import Estimate
from escape_hw.bench import Bench
from escape_hw.calibration.acquisition.sensor_setup import prepare_sensor
from escape_hw.calibration.loop.control import LoopChange, LoopControl, LoopSettings
from escape_hw.calibration.loop.divergence import ResidualMonitor
from escape_hw.calibration.loop.performance import peak_strehl
from escape_hw.calibration.loop.runner import RunningLoop
from escape_hw.errors import Aborted, CalibrationError, CommandRejected, FrameTimeout
from escape_hw.pipeline.psf.frame_stack import FrameStack
from escape_hw.pipeline.statistics import MIN_SAMPLES
from escape_hw.streams.realtime import PRIORITY, isolated_cpus, realtime_thread
from escape_hw.streams.timing import TimingSummary

log = logging.getLogger(__name__)

#: Seconds between two checks of requests, divergence and the science camera.
_CHECK_PERIOD_S = 0.1
#: Seconds between two updates of the displayed numbers, and of the latency histogram.
_METRICS_PERIOD_S, _HISTOGRAM_PERIOD_S = 0.25, 1.0
#: Consecutive time-outs of the camera after which the loop is opened.
_MAX_TIMEOUTS = 5
#: Frames in which the undriven part of the command fades after an exchange of the reconstructor.
_FADE_FRAMES = 100
#: Residuals kept for the display.
_N_RESIDUALS = 500


class RunningStrehl:
    """Strehl ratio of the science frames since the last evaluation, computed in another thread.

    ``model``: PSF without turbulence ``(rows, columns)``.
    """

    def __init__(self, model: NDArray[np.float32]) -> None:
        self._model = model
        self._pending: Future[Estimate | None] | None = None
        self._value = Estimate(math.nan, math.nan)

    def submit(self, images: FrameStack, pool: Executor) -> bool:
        """Evaluate images, if enough and if the last evaluation has ended; whether they were accepted."""
        if self._pending is not None:
            if not self._pending.done():
                return False
            self._value, self._pending = self._pending.result() or self._value, None
        if images.count < MIN_SAMPLES:
            return False
        self._pending = pool.submit(peak_strehl, images, self._model)
        return True

    def metrics(self) -> dict[str, float]:
        """Latest Strehl ratio of the peak, and its standard error; NaN before the first."""
        return {"strehl": self._value.value, "strehl_sigma": self._value.sigma}


@dataclass(frozen=True, slots=True, eq=False)
class LoopSummary:
    """Summary of a loop that ran until it was opened.

    ``fault``: why the loop was opened without a request; empty after a request. ``failed_device``: name of
    the device that was the cause, if one was.
    """

    fault: str
    settings: LoopSettings
    frames: int
    lost_frames: int
    timeouts: int
    timing: TimingSummary
    failed_device: str = ""


def run_until_opened(
    bench: Bench, loop_control: LoopControl, *, model_psf: NDArray[np.float32] | None = None
) -> Procedure[LoopSummary]:
    """Close the loop and keep it closed until a request or a fault opens it.

    The mirror is flat in the end in any case. On real devices the loop's thread asks for real-time priority;
    the log states what the operating system refused.

    Progress has no end: its ``total`` is 0. Metrics: ``residual_nm``, ``gain``, ``leak``, ``dropped_modes``,
    ``clipped`` (share of the actuators), ``lost``, ``timeouts``, ``latency_p50``, ``latency_p99``,
    ``latency_max``, ``jitter_p99`` (microseconds, last second), and with a model PSF ``strehl`` and
    ``strehl_sigma``. Arrays: ``residual``, and once a second ``latency_histogram`` (see
    :meth:`~escape_hw.streams.timing.LoopTiming.histograms`).

    Parameters
    ----------
    model_psf
        PSF without turbulence. With it and a science camera the Strehl ratio is measured.

    Returns
    -------
    LoopSummary
        ``fault`` is the reason if the loop was opened without a request: mirror at its limits, growing
        residual (``server.diverging_factor``, ``server.diverging_s``), no frames, no light, or a rejected
        command.

    Raises
    ------
    DeviceError
        A device failed or was lost.
    """
    return (yield from _ContinuousLoop(bench, loop_control, model_psf).run())


def _realtime_priority(bench: Bench) -> AbstractContextManager[tuple[str, ...]]:
    """Real-time priority for the loop's thread, except on twins, which compute without a pause."""
    if bench.simulated:
        return realtime_thread(priority=0)
    # The scheduler moves no thread between isolated processors, so the thread gets a single one.
    return realtime_thread(isolated_cpus()[:1] or None)


class _ContinuousLoop:
    """State of a run."""

    def __init__(
        self, bench: Bench, loop_control: LoopControl, model_psf: NDArray[np.float32] | None
    ) -> None:
        first = loop_control.take_change()
        if first is None:
            raise RuntimeError("a LoopControl serves one loop; create a new one")
        self.bench, self.loop_control, self.settings = bench, loop_control, first.settings
        self.strehl = None if model_psf is None or bench.science is None else RunningStrehl(model_psf)
        self.loop = RunningLoop(
            bench, first.settings.calibration.matrix.m2c, first.slopes_of, first.control,
            science=self.strehl is not None,
        )  # fmt: skip
        rate_hz = bench.wfs.settings.frame_rate_hz
        self.control = first.control
        self.residual_monitor = ResidualMonitor(bench.config.server, rate_hz)
        self.frames_per_check = max(1, round(_CHECK_PERIOD_S * rate_hz))
        self.fade_frames_left = 0
        self.fade_step = np.zeros(len(first.undriven))
        self.timeouts = self.consecutive_timeouts = 0
        self.failed_device = ""
        self.metrics: dict[str, float] = {}
        self.metrics_at = self.histogram_at = -math.inf
        self.clipped, self.frames_counted = bench.dm.clipped_count, 0

    def run(self) -> Procedure[LoopSummary]:
        """Close the loop, run it, open it."""
        loop, fault = self.loop, ""
        prepare_sensor(self.bench)
        report = Reporter("closed loop", 0)
        with (
            ThreadPoolExecutor(1, thread_name_prefix="running Strehl") as pool,
            _realtime_priority(self.bench) as refusals,
            loop.closed(),
        ):
            self._log_priority(refusals)
            try:
                while not self.loop_control.is_open_requested and not fault:
                    fault = yield from self._run_until_check(report)
                    self._handle_requests(pool)
            except Aborted:
                log.info("the loop is opened on request")
        if fault:
            log.error("the loop was opened: %s", fault)
        timing = loop.timing.since_start()
        return LoopSummary(
            fault, self.settings, loop.record.frames, loop.lost_frames, self.timeouts, timing,
            self.failed_device,
        )  # fmt: skip

    def _log_priority(self, refusals: tuple[str, ...]) -> None:
        if refusals:
            log.warning("frames may be answered late: %s", "; ".join(refusals))
        elif not self.bench.simulated:
            place = ", ".join(map(str, isolated_cpus()[:1])) or "any"
            log.info("real-time priority %d, memory held, processor: %s", PRIORITY, place)

    def _run_until_check(self, report: Reporter) -> Procedure[str]:
        """Process the frames until the next check; returns the fault, or an empty string."""
        loop, before = self.loop, self.loop.record.frames
        observers = (self._fade_undriven,) if self.fade_frames_left else ()
        try:
            for step in loop.run(self.frames_per_check, observe=observers, report=report):
                yield self._complete_progress(step)
        except FrameTimeout as error:
            self.timeouts += 1
            self.consecutive_timeouts = 1 if loop.record.frames > before else self.consecutive_timeouts + 1
            yield self._complete_progress(report.now({}))
            if self.consecutive_timeouts >= _MAX_TIMEOUTS:
                self.failed_device = error.device
                return f"no frame for {_MAX_TIMEOUTS} time-outs in a row ({error})"
        except CommandRejected as error:
            return f"a command was rejected: {error}"
        except CalibrationError as error:
            return str(error)
        if loop.record.diverged:
            return (
                "the actuators stayed at their limits: lower the gain or drop more modes; if that does not "
                "help, measure the matrix again"
            )
        residual = loop.record.residual
        if self.residual_monitor(residual[len(residual) - (loop.record.frames - before) :]):
            return (
                f"the residual grew {self.residual_monitor.growth:.2g}-fold: lower the gain, drop more "
                "modes, or measure the matrix again"
            )
        return ""

    def _handle_requests(self, pool: ThreadPoolExecutor) -> None:
        """Apply requests and start evaluations, in less than the time of a frame."""
        record = self.loop.record
        del record.residual[:-_N_RESIDUALS], record.latency[:]
        if (change := self.loop_control.take_change()) is not None:
            self._apply_change(change)
        if self.strehl is not None:
            if self.strehl.submit(record.science, pool):
                record.science = FrameStack()
            self.metrics |= self.strehl.metrics()

    def _apply_change(self, change: LoopChange) -> None:
        """Apply new settings: the state stays, and its part that is no longer driven fades."""
        change.control.set_applied(self.control.state)
        self.control = self.loop.control = change.control
        self.loop.slopes_of, self.settings = change.slopes_of, change.settings
        self.metrics_at = -math.inf
        undriven_state = change.undriven @ (change.undriven.T @ change.control.state)
        self.fade_step = undriven_state / _FADE_FRAMES
        self.fade_frames_left = _FADE_FRAMES if undriven_state.any() else 0

    def _fade_undriven(self, *_: object) -> None:
        """Subtract one fading step from the controller's state; an observer of the loop."""
        if self.fade_frames_left:
            self.fade_frames_left -= 1
            self.control.set_applied(self.control.state - self.fade_step)

    def _complete_progress(self, step: Progress) -> Progress:
        """Add the metrics and arrays of the whole run to the progress of a stretch."""
        now = time.monotonic()
        if now - self.metrics_at > _METRICS_PERIOD_S:
            self.metrics_at = now
            self._update_metrics()
        arrays: Mapping[str, NDArray[np.float32]] = step.arrays
        if now - self.histogram_at > _HISTOGRAM_PERIOD_S:
            self.histogram_at = now
            arrays = {**arrays, "latency_histogram": self.loop.timing.histograms()}
        return replace(
            step, done=self.loop.record.frames, metrics={**self.metrics, **step.metrics}, arrays=arrays
        )

    def _update_metrics(self) -> None:
        timing, s, bench = self.loop.timing.recent(), self.settings, self.bench
        clipped, frames = bench.dm.clipped_count, self.loop.record.frames
        n_clipped, n_frames = clipped - self.clipped, max(frames - self.frames_counted, 1)
        self.clipped, self.frames_counted = clipped, frames
        self.metrics |= {
            "gain": s.gain, "leak": s.leak, "dropped_modes": float(s.dropped_modes),
            "clipped": n_clipped / (n_frames * bench.dm.info.n_act),
            "lost": float(self.loop.lost_frames), "timeouts": float(self.timeouts),
            "latency_p50": timing.p50, "latency_p99": timing.p99, "latency_max": timing.largest,
            "jitter_p99": timing.jitter_p99,
        }  # fmt: skip
