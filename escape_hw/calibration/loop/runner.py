"""The closed loop frame by frame: start-up, controller, injected pokes, observers."""

from __future__ import annotations

import math
import time
from array import array
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Self

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.camera import Frame
from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.mirror import SendReport
from escape_hw.api.procedure import Procedure, Reporter
from escape_hw.api.sensor import SensorGeometry, SlopeFunction
from escape_hw.bench import Bench
from escape_hw.calibration.acquisition.frames import FluxMonitor, limit_to_reachable, next_frame
from escape_hw.calibration.acquisition.sensor_setup import build_slope_function, prepare_sensor
from escape_hw.calibration.loop.divergence import SaturationMonitor
from escape_hw.pipeline.control.integrator import LeakyIntegrator
from escape_hw.pipeline.control.matrix_products import build_command_mapper
from escape_hw.pipeline.psf.frame_stack import FrameStack
from escape_hw.pipeline.psf.strehl import is_peak_saturated
from escape_hw.pipeline.statistics import MIN_SAMPLES
from escape_hw.streams.timing import LoopTiming

#: Seconds after closing in which the loop settles; science frames taken meanwhile do not count.
SETTLING_S = 0.3
#: Residuals in a progress report.
_N_REPORTED = 500

#: Returns the modal poke of a frame ``(n_modes,)``.
PokeSource = Callable[[], NDArray[np.float64]]
#: Called after the command of each frame was sent, with the frame's index; its slopes ``(n_slopes,)``,
#: float32; the modal command that the mirror executed ``(n_modes,)``, float64, the sum of controller and poke
#: within the limits; and the poke in it ``(n_modes,)``, float64, zeros without pokes. The arrays are
#: overwritten by the next frame: copy what is to be kept.
LoopObserver = Callable[[int, NDArray[np.float32], NDArray[np.float64], NDArray[np.float64]], object]


def minimum_strehl_frames(loop_hz: float, science_hz: float) -> int:
    """Fewest frames of a loop after which its Strehl ratios have standard errors."""
    return math.ceil((SETTLING_S + (MIN_SAMPLES + 2) / science_hz) * loop_hz)


@dataclass(slots=True, eq=False)
class LoopRecord:
    """Measurements of a running loop.

    Parameters
    ----------
    science
        Frames of the science camera, from :data:`SETTLING_S` after closing on.
    residual
        Rms of the reconstructed wavefront by frame, in nm.
    latency
        Time from the arrival of a frame to its command by frame, in ns.
    shortened
        Number of commands that the mirror's limits changed.
    diverged
        Whether the run was stopped because the mirror stayed at its limits.
    last, command
        Last frame, and last command sent ``(n_act,)``.
    """

    science: FrameStack = field(default_factory=FrameStack)
    residual: array[float] = field(default_factory=lambda: array("f"))
    latency: array[int] = field(default_factory=lambda: array("q"))
    frames: int = 0
    shortened: int = 0
    diverged: bool = False
    last: Frame | None = None
    command: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))


class RunningLoop:
    """A loop that runs in stretches without being opened between them.

    Use it as ``with loop.closed(): yield from loop.run(frames)``. Between two frames the controller may get
    another reconstructor or another gain.

    ``bench``: an open bench, its sensor prepared; ``m2c``: mode-to-command matrix ``(n_act, n_modes)``.

    Attributes
    ----------
    record
        Measurements of all stretches, also of an aborted one.
    closed_at_ns
        Time at which the loop was closed, by the clock of the sensor's camera.
    """

    def __init__(
        self,
        bench: Bench,
        m2c: NDArray[np.float64],
        slopes_of: SlopeFunction,
        control: LeakyIntegrator,
        *,
        science: bool = False,
    ) -> None:
        self.bench, self.control, self.slopes_of, self.record = bench, control, slopes_of, LoopRecord()
        self.m2c = m2c
        self.timing = LoopTiming()
        self.settling_frames = int(SETTLING_S * bench.wfs.settings.frame_rate_hz)
        self.closed_at_ns = self._lost_before = 0
        self._to_actuators, self._to_modes = build_command_mapper(m2c), np.linalg.pinv(m2c)
        self._flux_monitor = FluxMonitor(bench.wfs.name, slopes_of.grid)
        self._is_saturated = SaturationMonitor(bench.config.server, len(m2c))
        self._science = bench.science if science else None
        # Reflection doubles the surface; modes have unit rms surface.
        self._nm_per_unit = 2e9 * bench.dm.info.stroke_m
        self._slopes = np.zeros(slopes_of.grid.n_slopes, np.float32)
        self._command, self._zero_poke = np.zeros(m2c.shape[1]), np.zeros(m2c.shape[1])
        self._zero_poke.flags.writeable = False
        self._residual_callback = bench.callbacks.residual
        self._residual_nm = np.zeros(m2c.shape[1], np.float32)

    @classmethod
    def prepare(
        cls,
        bench: Bench,
        matrix: InteractionMatrix,
        grid: SensorGeometry,
        control: LeakyIntegrator,
        *,
        science: bool = False,
    ) -> Self:
        """Prepare the sensor and build the loop of a matrix on its geometry; the mirror does not move.

        Raises
        ------
        IncompatibleProduct
            The geometry does not fit the camera or the sensor.
        CalibrationError
            The dark frame is of another camera region.
        SettingRejected, DeviceError
            The modulator cannot do what the configuration asks for, or did not start.
        """
        prepare_sensor(bench)
        return cls(bench, matrix.m2c, build_slope_function(bench, grid), control, science=science)

    @contextmanager
    def closed(self) -> Iterator[None]:
        """Context in which the loop is closed: the mirror is flattened on entry and on exit.

        A first frame is read on entry, so that frames which the camera lost before do not count.
        """
        self.bench.dm.flatten()
        next_frame(self.bench)
        self._lost_before, self.closed_at_ns = self.bench.wfs.status().lost, self.bench.wfs.now_ns()
        if self._science is not None:
            self._science.stop()
        try:
            yield
        finally:
            self.open()

    def open(self) -> None:
        """Flatten the mirror and stop the science camera."""
        self.bench.dm.flatten()
        if self._science is not None:
            self._science.stop()

    @property
    def lost_frames(self) -> int:
        """Frames that the camera lost since the loop was closed."""
        return self.bench.wfs.status().lost - self._lost_before

    @property
    def elapsed_s(self) -> float:
        """Seconds since the loop was closed, by the clock of the sensor's camera."""
        return (self.bench.wfs.now_ns() - self.closed_at_ns) * 1e-9

    def settle(
        self, frames: int | None = None, observe: Sequence[LoopObserver] = ()
    ) -> Procedure[LoopRecord]:
        """Run without pokes while the loop settles, for :attr:`settling_frames` by default."""
        frames = self.settling_frames if frames is None else frames
        return self.run(frames, observe=observe, report=Reporter("closing the loop", frames))

    def run(
        self,
        frames: int,
        *,
        inject: PokeSource | None = None,
        observe: Sequence[LoopObserver] = (),
        report: Reporter | None = None,
    ) -> Procedure[LoopRecord]:
        """Process a number of frames; the loop stays closed unless it diverged.

        Parameters
        ----------
        inject
            Source of pokes. Pokes are added to the controller's command and do not enter its state. With
            pokes, a command beyond the limits is shortened as a whole instead of actuator by actuator, so
            that it remains a known combination of the modes.
        report
            Progress reporter; a stage of its own by default.

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
            if self._science is not None and record.frames > self.settling_frames:
                image = self._science.poll()
                if image is not None and record.frames > self.settling_frames + 2:
                    record.science.add(image.data, clipped=is_peak_saturated(image))
            if report.step():
                latest = np.array(record.residual[-_N_REPORTED:], np.float32)
                yield report.now({"residual": latest}, residual_nm=record.residual[-1])
        return record

    def _process_frame(self, frame: Frame, poke: NDArray[np.float64], shorten_whole: bool) -> None:
        record, began = self.record, time.perf_counter_ns()
        self.slopes_of(frame.data, None, self._slopes)
        np.add(self.control(self._slopes), poke, out=self._command)
        sent, n_clipped = self._send(self._to_actuators(self._command), shorten_whole)
        ended = time.perf_counter_ns()
        record.latency.append(ended - began)
        self.timing.add(began, ended)
        self._flux_monitor(self.slopes_of.flux)
        if n_clipped is not None:
            record.shortened += 1
            np.dot(self._to_modes, sent.sent, out=self._command)
            self.control.set_applied(self._command - poke)
        record.diverged = self._is_saturated(n_clipped or 0)
        record.frames, record.last, record.command = record.frames + 1, frame, sent.sent
        residual = self.control.residual
        rms = self._nm_per_unit * float(np.sqrt(residual.dot(residual)))
        record.residual.append(rms)
        if self._residual_callback is not None:
            residual_nm = np.multiply(residual, self._nm_per_unit, out=self._residual_nm)
            self._residual_callback(frame.index, residual_nm, rms)

    def _send(self, shape: NDArray[np.float64], shorten_whole: bool) -> tuple[SendReport, int | None]:
        """Send a command; if the limits changed it, also the number of actuators asked beyond the stroke."""
        dm = self.bench.dm
        if not shorten_whole:
            sent = dm.send(shape)
            return sent, None if sent.guard.is_unchanged else sent.guard.clipped
        if dm.is_legal(shape):
            return dm.send(shape), None
        sent = dm.send(limit_to_reachable(dm, shape))
        return sent, int(np.count_nonzero(np.abs(shape) > dm.limits.max_stroke))
