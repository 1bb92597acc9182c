"""Our loop, end to end: a paced camera in a process of its own, a ring, the loop, the guard, a mirror."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from array import array
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.frames import CameraInfo, CameraSettings, Frame, Region
from escape_hw.api.mirror import DeformableMirror, DMInfo
from escape_hw.api.procedure import run as run_procedure
from escape_hw.api.sensor import SubApertureGrid
from escape_hw.api.taps import Taps
from escape_hw.bench import Bench
from escape_hw.calibration.loop_run import RunningLoop
from escape_hw.config.load import load_system
from escape_hw.pipeline.integrator import LeakyIntegrator
from escape_hw.pipeline.slopes import SlopeExtractor
from escape_hw.safety.limits import MirrorLimits
from escape_hw.streams.realtime import prompt
from escape_hw.streams.ring import RingWriter
from escape_hw.streams.ring_camera import RingCamera
from escape_hw.streams.segments import segment_name

#: Every rule of the guard is on.
LIMITS = MirrorLimits(max_stroke=0.8, max_slew=1.0, max_mean=0.5, max_neighbour=0.9)
#: Seconds about the time a frame is due in which nobody sleeps.
SPIN_S = 150e-6
#: Frames before those that count.
WARM_UP = 200
FULL_SCALE_BITS = 16


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """What both codes run.

    Parameters
    ----------
    frames
        Shown in turn ``(n, rows, columns)``.
    control
        Reconstructor ``(n_act, n_slopes)``.
    """

    n_sub: int
    pitch: int
    rate_hz: float
    frames: NDArray[np.uint16]
    control: NDArray[np.float32]

    @property
    def n_act(self) -> int:
        """Actuators, and modes."""
        return len(self.control)


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """Microseconds from a frame written to its command sent ``(n,)``, and how it went."""

    latency_us: NDArray[np.float64]
    rate_hz: float
    lost: int
    notes: tuple[str, ...] = ()


class BookingMirror(DeformableMirror):
    """A mirror that only books when commands come."""

    def __init__(self, n_act: int) -> None:
        super().__init__("dm", LIMITS)
        side = int(np.ceil(np.sqrt(n_act)))
        layout = (np.arange(side * side) < n_act).reshape(side, side)
        places = np.argwhere(layout)[:, ::-1].astype(np.float64)
        self._info = DMInfo("booking mirror", "0", n_act, layout, places, 1e-6, True)
        self.times = array("q")

    @property
    def info(self) -> DMInfo:
        """See the base class."""
        return self._info

    def _open(self) -> None:
        """Nothing to connect."""

    def _close(self) -> None:
        """Nothing to disconnect."""

    def _send(self, command: NDArray[np.float64]) -> None:
        self.times.append(time.monotonic_ns())


@contextmanager
def paced_camera(case: Case) -> Iterator[str]:
    """A process that writes the case's frames at its rate; yields the segment's name."""
    with tempfile.TemporaryDirectory(prefix="escape-perf-") as folder:
        file = Path(folder) / "frames.npy"
        np.save(file, case.frames)
        command = [
            sys.executable,
            "-m",
            "escape_hw.cli.benchmarks.paced_frames",
            str(file),
            str(case.rate_hz),
        ]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
            if process.stdin is None or process.stdout is None:
                raise RuntimeError("the camera's process has no pipes")
            try:
                yield process.stdout.readline().decode().strip()
            finally:
                process.stdin.close()
                process.wait(10)


def run_loop(case: Case, seconds: float, *, streams: bool = False) -> Run:
    """Close the loop on the case's frames for a while; with ``streams`` all it does goes to rings, too."""
    rows, columns = case.frames.shape[1:]
    info = CameraInfo("paced camera", "0", (rows, columns), FULL_SCALE_BITS, True)
    settings = CameraSettings(Region(0, 0, columns, rows), 0.5 / case.rate_hz, case.rate_hz)
    mirror = BookingMirror(case.n_act)
    with paced_camera(case) as segment:
        camera = RingCamera("wfs", segment, info, settings, spin_s=SPIN_S)
        arrived = array("q")
        with (
            _taps(case, arrived, streams) as taps,
            Bench(load_system("razor-shwfs"), mirror, camera) as bench,
            prompt() as notes,
        ):
            bench.taps = taps
            control = LeakyIntegrator(case.control, 0.2, 0.05)
            slopes_of = SlopeExtractor(_grid(case), (rows, columns))
            loop = RunningLoop(bench, np.eye(case.n_act), slopes_of, control)
            run_procedure(loop.run(WARM_UP))
            lost, first = bench.wfs.status().lost, len(arrived)
            run_procedure(loop.run(round(seconds * case.rate_hz)))
            lost = bench.wfs.status().lost - lost
            sent = np.array(mirror.times[first : len(arrived)])
    came = np.array(arrived[first:])
    rate = (len(came) - 1) / float(came[-1] - came[0]) * 1e9
    return Run((sent - came) / 1e3, rate, lost, notes)


@contextmanager
def _taps(case: Case, arrived: array[int], streams: bool) -> Iterator[Taps]:
    """Taps that book when frames came and, if asked for, write frames, commands and residuals to rings."""
    if not streams:
        yield Taps(frame=lambda frame: arrived.append(frame.arrived_ns))
        return
    with (
        RingWriter(segment_name("perf", "seen"), case.frames[0].nbytes) as frames,
        RingWriter(segment_name("perf", "commands"), 8 * case.n_act) as commands,
        RingWriter(segment_name("perf", "modes"), 4 * case.n_act) as modes,
    ):

        def frame(one: Frame) -> None:
            arrived.append(one.arrived_ns)
            frames.write(one.data, one.index, one.exposed_ns, one.arrived_ns)

        yield Taps(
            frame=frame,
            command=lambda shape: commands.write(shape, commands.written),
            residual=lambda index, residual, rms: modes.write(residual, index),
        )


def _grid(case: Case) -> SubApertureGrid:
    """Whole pixels, every lenslet lit."""
    valid = np.ones((case.n_sub, case.n_sub), np.bool_)
    half = (case.pitch - 1) / 2
    references = np.zeros((case.n_sub**2, 2), np.float32)
    return SubApertureGrid(float(case.pitch), (half, half), valid, references, valid.astype(np.float32))
