"""The loop frame by frame: controller, pokes beside it, and those who watch."""

from __future__ import annotations

import math
import time
from array import array
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.frames import Frame
from escape_hw.api.mirror import SendReport
from escape_hw.api.procedure import Procedure, Reporter
from escape_hw.api.sensor import SlopeFunction
from escape_hw.bench import Bench
from escape_hw.calibration.acquire import LightWatch, next_frame, reachable
from escape_hw.errors import CalibrationError
from escape_hw.pipeline.command_shape import shaper
from escape_hw.pipeline.controller import Controller
from escape_hw.pipeline.frame_stack import FrameStack
from escape_hw.pipeline.standard_error import LEAST
from escape_hw.pipeline.strehl import peak_is_clipped
from escape_hw.streams.loop_timing import LoopTiming

#: Seconds after closing during which the science frames do not count.
CLOSING_S = 0.3
#: The loop counts as diverging when this share of the actuators stays clipped ...
_SATURATED = 0.2
#: ... for this many frames in a row.
_SATURATED_FRAMES = 50

#: Gives the modal poke of a frame ``(n_modes,)``.
Injection = Callable[[], NDArray[np.float64]]
#: Gets, after each frame was answered: its index; its slopes ``(n_slopes,)``, float32; the modal command
#: that the mirror really got ``(n_modes,)``, float64, controller and poke together and within the limits;
#: the poke in it ``(n_modes,)``, float64, zeros without one. Both were sent after that frame had arrived.
#: The arrays are used again; what is to be kept must be copied.
LoopObserver = Callable[[int, NDArray[np.float32], NDArray[np.float64], NDArray[np.float64]], object]


#: Residuals that a progress report shows.
_SHOWN = 500


def frames_for_strehl(loop_hz: float, science_hz: float) -> int:
    """Least frames of a loop whose Strehl ratios have an error: while it closes, no science frame counts.

    Parameters
    ----------
    loop_hz, science_hz
        Frames per second of the sensor's and of the science camera.
    """
    return math.ceil((CLOSING_S + (LEAST + 2) / science_hz) * loop_hz)


def _newest(residual: array[float]) -> NDArray[np.float32]:
    return np.array(residual[-_SHOWN:], np.float32)


@dataclass(slots=True, eq=False)
class LoopRecord:
    """What a run gathers on its way.

    Parameters
    ----------
    science
        Frames of the science camera since the loop has been closed for :data:`CLOSING_S`.
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


def require_undiverged(record: LoopRecord) -> None:
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
        self._shape_of, self._to_modes = shaper(m2c), np.linalg.pinv(m2c)
        self._light = LightWatch(bench.wfs.name, slopes_of.grid)
        self._science = bench.science if science else None
        self._closing = int(CLOSING_S * bench.wfs.settings.frame_rate_hz)
        # Reflection doubles the surface; modes have unit rms surface.
        self._nm = 2e9 * bench.dm.info.stroke_m
        self._slopes = np.zeros(slopes_of.grid.n_slopes, np.float32)
        self._total, self._none = np.zeros(m2c.shape[1]), np.zeros(m2c.shape[1])
        self._none.flags.writeable = False
        self._saturated = 0
        self._tap = bench.taps.residual
        self._residual_nm = np.zeros(m2c.shape[1], np.float32)

    def run(
        self,
        frames: int,
        *,
        inject: Injection | None = None,
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
        poke = self._none if inject is None else inject()
        for _ in range(frames):
            frame = next_frame(self.bench)
            self._answer(frame, poke, inject is not None)
            for tell in observe:
                tell(frame.index, self._slopes, self._total, poke)
            if record.diverged:
                return record
            if inject is not None:
                # Drawn in the idle time before the next frame.
                poke = inject()
            if self._science is not None and record.frames > self._closing:
                image = self._science.poll()
                if image is not None and record.frames > self._closing + 2:
                    record.science.add(image.data, clipped=peak_is_clipped(image))
            if report.step():
                yield report.now({"residual": _newest(record.residual)}, residual_nm=record.residual[-1])
        return record

    def _answer(self, frame: Frame, poke: NDArray[np.float64], whole: bool) -> None:
        """Send the command that answers a frame, and book it."""
        record, began = self.record, time.perf_counter_ns()
        self.slopes_of(frame.data, None, self._slopes)
        np.add(self.control(self._slopes), poke, out=self._total)
        shape = self._shape_of(self._total)
        sent, over = self._sent(shape, whole)
        ended = time.perf_counter_ns()
        record.latency.append(ended - began)
        self.timing.add(began, ended)
        self._light(self.slopes_of.flux)
        if over is not None:
            record.shortened += 1
            np.dot(self._to_modes, sent.sent, out=self._total)
            self.control.applied(self._total - poke)
        self._saturated = self._saturated + 1 if over is not None and over > _SATURATED * shape.size else 0
        record.diverged = self._saturated >= _SATURATED_FRAMES
        record.frames, record.last, record.command = record.frames + 1, frame, sent.sent
        residual = self.control.residual
        rms = self._nm * float(np.sqrt(residual.dot(residual)))
        record.residual.append(rms)
        if self._tap is not None:
            self._tap(frame.index, np.multiply(residual, self._nm, out=self._residual_nm), rms)

    def _sent(self, shape: NDArray[np.float64], whole: bool) -> tuple[SendReport, int | None]:
        """What was sent, and how many actuators were asked beyond the stroke if it was not the shape."""
        dm = self.bench.dm
        if not whole:
            sent = dm.send(shape)
            return sent, None if sent.guard.untouched else sent.guard.clipped
        if dm.obeys(shape):
            return dm.send(shape), None
        sent = dm.send(reachable(dm, shape))
        return sent, int(np.count_nonzero(np.abs(shape) > dm.limits.max_stroke))
