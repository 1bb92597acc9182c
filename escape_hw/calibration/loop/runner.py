"""The loop frame by frame: controller, pokes beside it, and those who watch."""

from __future__ import annotations

import math
import time
from array import array
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.camera import Frame
from escape_hw.api.mirror import SendReport
from escape_hw.api.procedure import Procedure, Reporter
from escape_hw.api.sensor import SlopeFunction
from escape_hw.bench import Bench
from escape_hw.calibration.acquisition.frames import FluxMonitor, limit_to_reachable, next_frame
from escape_hw.errors import CalibrationError
from escape_hw.pipeline.control.integrator import Controller
from escape_hw.pipeline.control.matrix_products import build_command_mapper
from escape_hw.pipeline.psf.frame_stack import FrameStack
from escape_hw.pipeline.psf.strehl import is_peak_saturated
from escape_hw.pipeline.statistics import MIN_SAMPLES
from escape_hw.streams.timing import LoopTiming

#: Seconds after closing during which the science frames do not count.
SETTLING_S = 0.3
#: The loop counts as diverging when this share of the actuators stays clipped ...
_SATURATED_FRACTION = 0.2
#: ... for this many frames in a row.
_SATURATED_FRAMES = 50

#: Gives the modal poke of a frame ``(n_modes,)``.
PokeSource = Callable[[], NDArray[np.float64]]
#: Gets, after each frame was answered: its index; its slopes ``(n_slopes,)``, float32; the modal command
#: that the mirror really got ``(n_modes,)``, float64, controller and poke together and within the limits;
#: the poke in it ``(n_modes,)``, float64, zeros without one. Both were sent after that frame had arrived.
#: The arrays are used again; what is to be kept must be copied.
LoopObserver = Callable[[int, NDArray[np.float32], NDArray[np.float64], NDArray[np.float64]], object]


#: Residuals that a progress report shows.
_N_REPORTED = 500


def minimum_strehl_frames(loop_hz: float, science_hz: float) -> int:
    """Least frames of a loop whose Strehl ratios have an error: while it closes, no science frame counts.

    Parameters
    ----------
    loop_hz, science_hz
        Frames per second of the sensor's and of the science camera.
    """
    return math.ceil((SETTLING_S + (MIN_SAMPLES + 2) / science_hz) * loop_hz)


def _latest_residuals(residual: array[float]) -> NDArray[np.float32]:
    return np.array(residual[-_N_REPORTED:], np.float32)


@dataclass(slots=True, eq=False)
class LoopRecord:
    """What a run gathers on its way.

    Parameters
    ----------
    science
        Frames of the science camera since the loop has been closed for :data:`SETTLING_S`.
    residual
        Rms of the reconstructed wavefront, in nanometres, by frame.
    latency
        Nanoseconds from a frame in hand to its command sent, by frame.
    frames
        Frames answered.
    shortened
        Commands that the limits cut.
    diverged
        Whether the mirror was held at its limits for too long, and the run was stopped for that.
    last, command
        The last frame, and the last shape sent ``(n_act,)``.
    """

    science: FrameStack = field(default_factory=FrameStack)
    residual: array[float] = field(default_factory=lambda: array("f"))
    latency: array[int] = field(default_factory=lambda: array("q"))
    frames: int = 0
    shortened: int = 0
    diverged: bool = False
    last: Frame | None = None
    command: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))


def require_not_diverged(record: LoopRecord) -> None:
    """Refuse to go on with a loop that had to be opened.

    Raises
    ------
    CalibrationError
        It diverged; says what to do.
    """
    if record.diverged:
        raise CalibrationError(
            f"the loop diverged after {record.frames} frames and was opened: most actuators stood at "
            "their limits. Lower loop.gain or raise loop.dropped_modes; if that does not help, the "
            "matrix does not belong to this state of the bench, or the delay is longer than thought"
        )


class RunningLoop:
    """A loop that can be run in stretches without being opened between them.

    Whoever makes one flattens the mirror before the first stretch and in a ``finally`` after the last.
    Between two frames the controller may be given another reconstructor or other gains.

    Parameters
    ----------
    bench
        An open bench, its sensor prepared.
    m2c
        Mode-to-command matrix ``(n_act, n_modes)``.
    slopes_of
        Turns frames into slopes.
    control
        The modal controller.
    science
        Whether to gather the frames of the science camera.

    Attributes
    ----------
    record
        What all stretches gathered so far, also when one of them was aborted.
    timing
        Latencies and the spacing of frames since the loop was made.
    """

    def __init__(
        self,
        bench: Bench,
        m2c: NDArray[np.float64],
        slopes_of: SlopeFunction,
        control: Controller,
        *,
        science: bool = False,
    ) -> None:
        self.bench, self.control, self.slopes_of, self.record = bench, control, slopes_of, LoopRecord()
        self.m2c = m2c
        self.timing = LoopTiming()
        self._shape_of, self._to_modes = build_command_mapper(m2c), np.linalg.pinv(m2c)
        self._flux_monitor = FluxMonitor(bench.wfs.name, slopes_of.grid)
        self._science = bench.science if science else None
        self._settling_frames = int(SETTLING_S * bench.wfs.settings.frame_rate_hz)
        # Reflection doubles the surface; modes have unit rms surface.
        self._nm_per_unit = 2e9 * bench.dm.info.stroke_m
        self._slopes = np.zeros(slopes_of.grid.n_slopes, np.float32)
        self._command, self._zero_poke = np.zeros(m2c.shape[1]), np.zeros(m2c.shape[1])
        self._zero_poke.flags.writeable = False
        self._n_saturated = 0
        self._residual_callback = bench.callbacks.residual
        self._residual_nm = np.zeros(m2c.shape[1], np.float32)

    def run(
        self,
        frames: int,
        *,
        inject: PokeSource | None = None,
        observe: Sequence[LoopObserver] = (),
        report: Reporter | None = None,
    ) -> Procedure[LoopRecord]:
        """Answer a number of frames; the loop stays closed, unless it diverged.

        Parameters
        ----------
        frames
            How many.
        inject
            Gives each frame's poke, which is added beside the controller, never to its state. While
            pokes are injected, a command beyond the limits is shortened as a whole instead of
            actuator by actuator: so it remains a command of the modes, and known as such.
        observe
            Called after each frame, when its command is out.
        report
            Counts the frames for the progress; a stage of its own by default.

        Raises
        ------
        CalibrationError
            The sensor went dark.
        CommandRejected, DeviceError
            A command is not finite, or a device failed.
        """
        report = Reporter("closed loop", frames) if report is None else report
        record = self.record
        poke = self._zero_poke if inject is None else inject()
        for _ in range(frames):
            frame = next_frame(self.bench)
            self._process_frame(frame, poke, inject is not None)
            for observer in observe:
                observer(frame.index, self._slopes, self._command, poke)
            if record.diverged:
                return record
            if inject is not None:
                # Drawn in the idle time before the next frame.
                poke = inject()
            if self._science is not None and record.frames > self._settling_frames:
                image = self._science.poll()
                if image is not None and record.frames > self._settling_frames + 2:
                    record.science.add(image.data, clipped=is_peak_saturated(image))
            if report.step():
                yield report.now(
                    {"residual": _latest_residuals(record.residual)}, residual_nm=record.residual[-1]
                )
        return record

    def _process_frame(self, frame: Frame, poke: NDArray[np.float64], shorten_whole: bool) -> None:
        """Send the command that answers a frame, and book it."""
        record, began = self.record, time.perf_counter_ns()
        self.slopes_of(frame.data, None, self._slopes)
        np.add(self.control(self._slopes), poke, out=self._command)
        shape = self._shape_of(self._command)
        sent, n_clipped = self._send(shape, shorten_whole)
        ended = time.perf_counter_ns()
        record.latency.append(ended - began)
        self.timing.add(began, ended)
        self._flux_monitor(self.slopes_of.flux)
        if n_clipped is not None:
            record.shortened += 1
            np.dot(self._to_modes, sent.sent, out=self._command)
            self.control.set_applied(self._command - poke)
        self._n_saturated = (
            self._n_saturated + 1
            if n_clipped is not None and n_clipped > _SATURATED_FRACTION * shape.size
            else 0
        )
        record.diverged = self._n_saturated >= _SATURATED_FRAMES
        record.frames, record.last, record.command = record.frames + 1, frame, sent.sent
        residual = self.control.residual
        rms = self._nm_per_unit * float(np.sqrt(residual.dot(residual)))
        record.residual.append(rms)
        if self._residual_callback is not None:
            self._residual_callback(
                frame.index, np.multiply(residual, self._nm_per_unit, out=self._residual_nm), rms
            )

    def _send(self, shape: NDArray[np.float64], shorten_whole: bool) -> tuple[SendReport, int | None]:
        """What was sent, and how many actuators were asked beyond the stroke if it was not the shape."""
        dm = self.bench.dm
        if not shorten_whole:
            sent = dm.send(shape)
            return sent, None if sent.guard.is_unchanged else sent.guard.clipped
        if dm.is_legal(shape):
            return dm.send(shape), None
        sent = dm.send(limit_to_reachable(dm, shape))
        return sent, int(np.count_nonzero(np.abs(shape) > dm.limits.max_stroke))
