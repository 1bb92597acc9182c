"""The loop as an operator runs it: closed until told, with settings that change on the way."""

from __future__ import annotations

import logging
import math
import time
from array import array
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.procedure import Procedure, Progress, Reporter
from escape_hw.bench import Bench
from escape_hw.calibration.acquire import next_frame
from escape_hw.calibration.loop_orders import Change, LoopOrders, LoopSettings
from escape_hw.calibration.loop_run import RunningLoop
from escape_hw.calibration.loop_watch import DivergenceWatch
from escape_hw.calibration.running_strehl import RunningStrehl
from escape_hw.calibration.sensor_setup import prepare_sensor
from escape_hw.errors import Aborted, CalibrationError, CommandRejected, FrameTimeout
from escape_hw.pipeline.frame_stack import FrameStack
from escape_hw.streams.loop_timing import Timing
from escape_hw.streams.realtime import PRIORITY, isolated_cpus, prompt

log = logging.getLogger(__name__)

#: Seconds between two looks at orders, watchdogs and the science camera.
_STEP_S = 0.1
#: Seconds between two counts for the display.
_TOLD_S = 0.25
#: Time-outs in a row that open the loop.
_TIMEOUTS = 5
#: Frames over which what a new reconstructor does not drive any more fades from the mirror.
_FADE_FRAMES = 100
#: Residuals kept for the display.
_KEPT = 500


@dataclass(frozen=True, slots=True, eq=False)
class LoopEnd:
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
    timing: Timing


def keep_closed(
    bench: Bench, orders: LoopOrders, *, model_psf: NDArray[np.float32] | None = None
) -> Procedure[LoopEnd]:
    """Close the loop and keep it closed until ``orders`` say to open it, or something is wrong.

    The mirror ends flat in any case. On devices that are no twins the loop's thread asks for real-time
    priority, and the log says what the system refused.

    The procedure reports without an end: its ``total`` is 0. Metrics:
    ``residual_nm``, ``gain``, ``leak``, ``dropped_modes``, ``clipped`` (share of the actuators), ``lost``,
    ``latency_p50``, ``latency_p99``, ``latency_max``, ``jitter_p99`` (microseconds, last second), and with
    a model PSF ``strehl`` and ``strehl_sigma``. Arrays: ``residual``, and once a second
    ``latency_histogram``, see :meth:`~escape_hw.streams.loop_timing.LoopTiming.histograms`.

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
    return (yield from _Keeper(bench, orders, model_psf).run())


def _punctual(bench: Bench) -> AbstractContextManager[tuple[str, ...]]:
    """Priority for the loop's thread; a twin computes all the time and would starve the computer."""
    if bench.simulated:
        return prompt(priority=0)
    # Nothing moves a thread from one isolated processor to another, so one is what it gets.
    return prompt(isolated_cpus()[:1] or None)


class _Keeper:
    """State of a run."""

    def __init__(self, bench: Bench, orders: LoopOrders, model_psf: NDArray[np.float32] | None) -> None:
        first = orders.take()
        if first is None:
            raise RuntimeError("orders serve one loop; make new ones")
        self.bench, self.orders, self.settings = bench, orders, first.settings
        self.strehl = None if model_psf is None or bench.science is None else RunningStrehl(model_psf)
        self.loop = RunningLoop(
            bench, first.settings.closing.matrix.m2c, first.slopes_of, first.control,
            science=self.strehl is not None,
        )  # fmt: skip
        self.control, self.diverges = first.control, DivergenceWatch()
        self.fading = 0
        self.part = np.zeros(len(first.outside))
        self.timeouts = self.in_a_row = self.lost_before = 0
        self.metrics: dict[str, float] = {}
        self.arrays: dict[str, NDArray[np.float32]] = {}
        self.told = self.counted = -math.inf
        self.clipped, self.answered = bench.dm.clipped_count, 0

    def run(self) -> Procedure[LoopEnd]:
        """Close, keep, open."""
        bench, fault = self.bench, ""
        prepare_sensor(bench)
        bench.dm.flatten()
        next_frame(bench)
        self.lost_before = bench.wfs.status().lost
        if self.strehl is not None and bench.science is not None:
            bench.science.stop()
        stretch = max(1, round(_STEP_S * bench.wfs.settings.frame_rate_hz))
        report = Reporter("closed loop", 0)
        with ThreadPoolExecutor(1, thread_name_prefix="running Strehl") as pool, _punctual(bench) as refused:
            self._tell_priority(refused)
            try:
                while not self.orders.opened and not fault:
                    fault = yield from self._stretch(stretch, report)
                    self._between(pool)
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
        return LoopEnd(fault, self.settings, frames, lost, self.timeouts, timing)

    def _tell_priority(self, refused: tuple[str, ...]) -> None:
        if refused:
            log.warning("frames may be answered late: %s", "; ".join(refused))
        elif not self.bench.simulated:
            place = ", ".join(map(str, isolated_cpus()[:1])) or "any"
            log.info("real-time priority %d, memory held, processor: %s", PRIORITY, place)

    def _stretch(self, frames: int, report: Reporter) -> Procedure[str]:
        """Answer some frames; what is wrong, if anything."""
        loop, before = self.loop, self.loop.record.frames
        observers = (self._fade,) if self.fading else ()
        fault = ""
        try:
            for step in loop.run(frames, observe=observers, report=report):
                yield self._told(step)
        except FrameTimeout as error:
            self.timeouts += 1
            self.in_a_row = 1 if loop.record.frames > before else self.in_a_row + 1
            yield self._told(report.now({}))
            if self.in_a_row >= _TIMEOUTS:
                return f"no frame for {_TIMEOUTS} time-outs in a row ({error})"
        except CommandRejected as error:
            return f"a command was refused: {error}"
        except CalibrationError as error:
            return str(error)
        if loop.record.diverged:
            fault = (
                "most actuators stood at their limits: lower the gain or drop more modes; if that does not "
                "help, the matrix does not belong to this state of the bench"
            )
        elif self.diverges(self._residuals_since(before)):
            fault = (
                f"the residual grew {self.diverges.growth:.2g}-fold: lower the gain, drop more modes, or "
                "measure the matrix again"
            )
        return fault

    def _residuals_since(self, frames: int) -> array[float]:
        residual = self.loop.record.residual
        return residual[len(residual) - (self.loop.record.frames - frames) :]

    def _between(self, pool: ThreadPoolExecutor) -> None:
        """What is done between two stretches, in less than the time of a frame."""
        record = self.loop.record
        del record.residual[:-_KEPT], record.latency[:]
        if (change := self.orders.take()) is not None:
            self._exchange(change)
        if self.strehl is not None:
            if self.strehl.take(record.science, pool):
                record.science = FrameStack()
            self.metrics |= self.strehl.metrics()

    def _exchange(self, change: Change) -> None:
        """Go on with other settings: the state stays, and what nobody drives any more fades."""
        change.control.applied(self.control.state)
        self.control = self.loop.control = change.control
        self.loop.slopes_of, self.settings = change.slopes_of, change.settings
        self.told = -math.inf
        idle = change.outside @ (change.outside.T @ change.control.state)
        self.part, self.fading = idle / _FADE_FRAMES, _FADE_FRAMES if idle.any() else 0

    def _fade(self, *_: object) -> None:
        """Take a share of the fading part off the controller's state; as a loop's observer."""
        if self.fading:
            self.fading -= 1
            self.control.applied(self.control.state - self.part)

    def _told(self, step: Progress) -> Progress:
        """Progress of a stretch with what is known of the whole."""
        now = time.monotonic()
        if now - self.told > _TOLD_S:
            self.told = now
            self._count()
        arrays: Mapping[str, NDArray[np.float32]] = step.arrays
        if now - self.counted > 1.0:
            self.counted = now
            arrays = {**arrays, "latency_histogram": self.loop.timing.histograms()}
        return replace(
            step, done=self.loop.record.frames, metrics={**self.metrics, **step.metrics}, arrays=arrays
        )

    def _count(self) -> None:
        """Numbers of the last second."""
        timing, s, bench = self.loop.timing.lately(), self.settings, self.bench
        clipped, frames = bench.dm.clipped_count, self.loop.record.frames
        new, answered = clipped - self.clipped, max(frames - self.answered, 1)
        self.clipped, self.answered = clipped, frames
        self.metrics |= {
            "gain": s.gain, "leak": s.leak, "dropped_modes": float(s.dropped_modes),
            "clipped": new / (answered * bench.dm.info.n_act),
            "lost": float(bench.wfs.status().lost - self.lost_before), "timeouts": float(self.timeouts),
            "latency_p50": timing.p50, "latency_p99": timing.p99, "latency_max": timing.largest,
            "jitter_p99": timing.jitter_p99,
        }  # fmt: skip
