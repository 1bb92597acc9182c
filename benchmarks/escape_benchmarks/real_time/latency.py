"""Loop latency from frame written to command sent, beside pyRTC's pipeline on the same frames."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
import uuid
from array import array
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_benchmarks.peers.pyrtcao import NOT_INSTALLED, import_pyrtc, peer_name
from escape_benchmarks.real_time.pipeline import spots
from escape_benchmarks.real_time.ring_camera import RingCamera
from escape_hw.api.benchmark import BenchmarkRow
from escape_hw.api.callbacks import Callbacks
from escape_hw.api.camera import CameraInfo, CameraSettings, Frame, Region
from escape_hw.api.mirror import DeformableMirror, DMInfo
from escape_hw.api.procedure import run as run_procedure
from escape_hw.api.sensor import SubApertureGrid
from escape_hw.bench import Bench
from escape_hw.calibration.loop.runner import RunningLoop
from escape_hw.config.loader import load_system
from escape_hw.pipeline.control.integrator import LeakyIntegrator
from escape_hw.pipeline.slopes.shack_hartmann import ShackHartmannSlopes
from escape_hw.safety.limits import MirrorLimits
from escape_hw.streams.realtime import realtime_thread
from escape_hw.streams.ring import RingWriter
from escape_hw.streams.segments import segment_name

#: Every rule of the guard is on.
LIMITS = MirrorLimits(max_stroke=0.8, max_slew=1.0, max_mean=0.5, max_neighbour=0.9)
#: Seconds of busy waiting before a frame is due.
SPIN_S = 150e-6
#: Frames before the evaluated ones.
WARM_UP = 200
FULL_SCALE_BITS = 16


@dataclass(frozen=True, slots=True, eq=False)
class LatencyCase:
    """Case that both packages run.

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
class LatencyResult:
    """Microseconds from a frame written to its command sent ``(n,)``, and how it went."""

    latency_us: NDArray[np.float64]
    rate_hz: float
    lost: int
    notes: tuple[str, ...] = ()


class TimestampingMirror(DeformableMirror):
    """A mirror that only records the times of commands."""

    def __init__(self, n_act: int) -> None:
        super().__init__("dm", LIMITS)
        side = int(np.ceil(np.sqrt(n_act)))
        layout = (np.arange(side * side) < n_act).reshape(side, side)
        places = np.argwhere(layout)[:, ::-1].astype(np.float64)
        self._info = DMInfo("timestamping mirror", "0", n_act, layout, places, 1e-6, True)
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
def paced_camera(case: LatencyCase) -> Iterator[str]:
    """A process that writes the case's frames at its rate; yields the segment's name."""
    with tempfile.TemporaryDirectory(prefix="escape-perf-") as folder:
        file = Path(folder) / "frames.npy"
        np.save(file, case.frames)
        command = [
            sys.executable,
            "-m",
            "escape_benchmarks.real_time.paced_camera",
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


def run_loop(case: LatencyCase, seconds: float, *, streams: bool = False) -> LatencyResult:
    """Close the loop on the case's frames; with ``streams``, also write all data to rings."""
    rows, columns = case.frames.shape[1:]
    info = CameraInfo("paced camera", "0", (rows, columns), FULL_SCALE_BITS, True)
    settings = CameraSettings(Region(0, 0, columns, rows), 0.5 / case.rate_hz, case.rate_hz)
    mirror = TimestampingMirror(case.n_act)
    with paced_camera(case) as segment:
        camera = RingCamera("wfs", segment, info, settings, spin_s=SPIN_S)
        arrived = array("q")
        with (
            _callbacks(case, arrived, streams) as callbacks,
            Bench(load_system("razor-shwfs"), mirror, camera) as bench,
            realtime_thread() as notes,
        ):
            bench.callbacks = callbacks
            control = LeakyIntegrator(case.control, 0.2, 0.05)
            slopes_of = ShackHartmannSlopes(_grid(case), (rows, columns))
            loop = RunningLoop(bench, np.eye(case.n_act), slopes_of, control)
            run_procedure(loop.run(WARM_UP))
            lost, first = bench.wfs.status().lost, len(arrived)
            run_procedure(loop.run(round(seconds * case.rate_hz)))
            lost = bench.wfs.status().lost - lost
            sent = np.array(mirror.times[first : len(arrived)])
    arrival_ns = np.array(arrived[first:])
    rate = (len(arrival_ns) - 1) / float(arrival_ns[-1] - arrival_ns[0]) * 1e9
    return LatencyResult((sent - arrival_ns) / 1e3, rate, lost, notes)


@contextmanager
def _callbacks(case: LatencyCase, arrived: array[int], streams: bool) -> Iterator[Callbacks]:
    """Callbacks that record arrival times and, with ``streams``, write all data to rings."""
    if not streams:
        yield Callbacks(frame=lambda frame: arrived.append(frame.arrived_ns))
        return
    with (
        RingWriter(segment_name("perf", "seen"), case.frames[0].nbytes) as frames,
        RingWriter(segment_name("perf", "commands"), 8 * case.n_act) as commands,
        RingWriter(segment_name("perf", "modes"), 4 * case.n_act) as modes,
    ):

        def frame(one: Frame) -> None:
            arrived.append(one.arrived_ns)
            frames.write(one.data, one.index, one.exposed_ns, one.arrived_ns)

        yield Callbacks(
            frame=frame,
            command=lambda shape: commands.write(shape, commands.written),
            residual=lambda index, residual, rms: modes.write(residual, index),
        )


def _grid(case: LatencyCase) -> SubApertureGrid:
    """Whole pixels, every lenslet lit."""
    valid = np.ones((case.n_sub, case.n_sub), np.bool_)
    half = (case.pitch - 1) / 2
    references = np.zeros((case.n_sub**2, 2), np.float32)
    return SubApertureGrid(float(case.pitch), (half, half), valid, references, valid.astype(np.float32))


#: Seconds for its threads to start.
_WARM_UP_S = 2.0
_STREAMS = ("wfs_raw", "wfs", "signal", "signal_2d", "wfc", "wfc_2d")


def run_peer(case: LatencyCase, seconds: float) -> LatencyResult | None:
    """Latency by pyRTC's own measure, frame published to command published; ``None``: not installed."""
    latency, streams = import_pyrtc("latency"), import_pyrtc("streams")
    if latency is None or streams is None:
        return None
    tag = f"escape_{uuid.uuid4().hex[:8]}"
    names = {key: f"{tag}_{key}" for key in _STREAMS}
    parts = _components(case, names)
    try:
        for part in parts:
            part.start()
        time.sleep(_WARM_UP_S)
        commands = streams.open_stream(names["wfc"], readonly=True)
        before, began = commands.count, time.perf_counter()
        report, _ = latency.measure_stream_path_latency(
            [names["wfs"], names["signal"], names["wfc"]], samples=round(seconds * case.rate_hz),
            timeout_seconds=4 * seconds + 10,
        )  # fmt: skip
        rate = (commands.count - before) / (time.perf_counter() - began)
        commands.close()
    except TimeoutError:
        return LatencyResult(np.array([]), 0.0, 0, ("the peer's own measurement timed out",))
    finally:
        for part in reversed(parts):
            part.close()
        streams.clear_shms(list(names.values()))
    s = report.total.statistics
    # Its report keeps percentiles only: the median and the 99th stand for all.
    return LatencyResult(np.array([s.p50_seconds, s.p99_seconds]) * 1e6, rate, 0)


def _components(case: LatencyCase, n: dict[str, str]) -> tuple[Any, ...]:
    """Corrector, slopes, loop and sensor, in the order in which they start."""
    slopes_process, loop, corrector = (
        import_pyrtc(name) for name in ("slopes_process", "loop", "wavefront_corrector")
    )
    if slopes_process is None or loop is None or corrector is None:
        raise RuntimeError("pyRTC is installed in part only")
    side = case.frames.shape[1]
    wfs = _replay(case)(
        {"name": "w", "width": side, "height": side, "functions": ["expose"],
         "input_streams": {"wfc": n["wfc"]}, "output_streams": {"wfs_raw": n["wfs_raw"], "wfs": n["wfs"]}}
    )  # fmt: skip
    slopes = slopes_process.SlopesProcess(
        {"type": "SHWFS", "signal_type": "slopes", "sub_ap_spacing": case.pitch, "sub_ap_offset_x": 0,
         "sub_ap_offset_y": 0, "image_noise": 0.0, "contrast": 3, "functions": ["compute_signal"],
         "input_streams": {"wfs": n["wfs"]},
         "output_streams": {"signal": n["signal"], "signal_2d": n["signal_2d"]}}
    )  # fmt: skip
    mirror = corrector.WavefrontCorrector(
        {"name": "d", "num_actuators": case.n_act, "num_modes": case.n_act, "functions": ["send_to_hardware"],
         "input_streams": {"wfc": n["wfc"]}, "output_streams": {"wfc": n["wfc"], "wfc_2d": n["wfc_2d"]}}
    )  # fmt: skip
    control = loop.Loop(
        {"functions": ["leaky_integrator"], "gain": 0.2, "leaky_gain": 0.05,
         "input_streams": {"signal": n["signal"]}, "output_streams": {"wfc": n["wfc"]}}
    )  # fmt: skip
    control.cm[:] = case.control
    control.gain = 0.2
    return mirror, slopes, control, wfs


def _replay(case: LatencyCase) -> type:
    """A sensor of the peer's kind that publishes the case's frames at its rate."""
    sensor = import_pyrtc("wavefront_sensor")
    if sensor is None:
        raise RuntimeError("pyRTC is installed in part only")
    base: type = sensor.WavefrontSensor

    def expose(self: Any) -> None:
        now = time.perf_counter()
        self.due = now if now - self.due > 0.1 else self.due
        if self.due > now:
            time.sleep(self.due - now)
        self.due += 1 / case.rate_hz
        self.data = case.frames[self.shown % len(case.frames)]
        self.shown += 1
        base.expose(self)  # type: ignore[attr-defined]

    return type("Replay", (base,), {"expose": expose, "due": 0.0, "shown": 0})


#: Lenslets across, pixels each, actuators, frames per second.
CASES = ((10, 8, 97, 1000.0), (40, 8, 1200, 500.0))
#: Seconds of ours, long enough for a loss to show, and of the peer's.
SECONDS, PEER_SECONDS = 20.0, 5.0
#: Seconds of the loop with and without streams.
STREAMS_SECONDS = 5.0


def run() -> list[BenchmarkRow]:
    """All rows of the stage."""
    rows = []
    for n_sub, pitch, n_act, rate in CASES:
        case = make_case(n_sub, pitch, n_act, rate)
        # One after the other: together they would fight for the processors.
        peer = run_peer(case, PEER_SECONDS)
        rows += _rows(case, run_loop(case, SECONDS), peer)
    return rows + _streams(make_case(*CASES[0]))


def _streams(case: LatencyCase) -> list[BenchmarkRow]:
    """What it costs a loop that all it does goes to shared memory."""
    without_streams, with_streams = (
        run_loop(case, STREAMS_SECONDS),
        run_loop(case, STREAMS_SECONDS, streams=True),
    )
    rows = []
    for label, share in (("median", 50.0), ("99th percentile", 99.0)):
        ours, peer = (float(np.percentile(one.latency_us, share)) for one in (with_streams, without_streams))
        stage = f"latency: {case.n_act} actuators, all streams written, {label}"
        note = f"{with_streams.lost} lost with, {without_streams.lost} without"
        rows.append(BenchmarkRow(stage, ours, peer, "the same loop without streams", "us", "lower", note))
    return rows


def make_case(n_sub: int, pitch: int, n_act: int, rate_hz: float) -> LatencyCase:
    """Frames of spots that move, and a reconstructor of noise that keeps the mirror within its limits."""
    frames = np.stack([spots(n_sub, pitch, seed) for seed in range(8)])
    noise = np.random.default_rng(0).normal(0, 1e-4, (n_act, 2 * n_sub**2))
    return LatencyCase(n_sub, pitch, rate_hz, frames, noise.astype(np.float32))


def _rows(case: LatencyCase, ours: LatencyResult, peer: LatencyResult | None) -> list[BenchmarkRow]:
    note = (
        f"{len(ours.latency_us)} frames at {ours.rate_hz:.0f} Hz, {ours.lost} lost; {'; '.join(ours.notes)}"
    )
    note = note.removesuffix("; ")
    if peer is None:
        note += f"; {NOT_INSTALLED}"
    else:
        note += f"; {'; '.join(peer.notes) or f'the peer answered {peer.rate_hz:.0f} frames per second'}"
    what = f"latency: {case.n_act} actuators, {case.rate_hz:.0f} Hz"
    shares = {"median": 50.0, "99th percentile": 99.0}
    rows = []
    for k, (label, share) in enumerate(shares.items()):
        theirs = None if peer is None or not peer.latency_us.size else float(peer.latency_us[k])
        rows.append(
            BenchmarkRow(
                f"{what}, {label}", float(np.percentile(ours.latency_us, share)), theirs,
                peer_name("sensor, slopes, leaky integrator"), "us", "lower", note,
            )
        )  # fmt: skip
    largest, no_peer = float(ours.latency_us.max()), peer_name("its report has none")
    rows.append(BenchmarkRow(f"{what}, largest", largest, None, no_peer, "us", "lower", note))
    return rows
