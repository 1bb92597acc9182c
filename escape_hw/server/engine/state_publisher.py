"""State of the engine, its devices and its geometry as documents for clients, published periodically."""

from __future__ import annotations

import logging
import math
import os
import shutil
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from escape_hw.api.camera import Frame
from escape_hw.api.device import Device
from escape_hw.api.sensor import SensorGeometry
from escape_hw.bench import Bench
from escape_hw.io.provenance import format_utc, get_software_version
from escape_hw.pipeline.statistics import root_mean_square
from escape_hw.remote.state import (
    DeviceHealth,
    DeviceState,
    DiskState,
    FrameCounters,
    Geometry,
    Illumination,
    LatencyState,
    LoopState,
    MirrorState,
    OffsetsState,
    RecordingState,
    State,
)
from escape_hw.runtime.session.record import actuator_layout, actuator_positions
from escape_hw.runtime.session.recordings import RecordingDescription
from escape_hw.server.engine.product_store import ProductStore
from escape_hw.server.engine.publisher import StreamPublisher
from escape_hw.server.engine.state import EngineSnapshot, EngineState
from escape_hw.supervision import BackgroundThread

log = logging.getLogger(__name__)

PUBLISH_PERIOD_S = 0.2
#: Time over which the share of clipped actuators is averaged.
_CLIPPED_S = 1.0
#: Time over which the frame rate is averaged; longer than the interval of frames while nothing runs.
_RATE_S = 0.5


class StatePublisher:
    """Publishes the engine's state five times a second, in a thread of its own; reads no device."""

    def __init__(
        self,
        bench: Bench,
        engine_state: EngineState,
        publisher: StreamPublisher,
        product_store: ProductStore,
        runs: Path,
        emit: Callable[[State], object],
        recording: Callable[[], RecordingState] = RecordingState,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._bench, self._engine_state = bench, engine_state
        self._publisher, self._product_store = publisher, product_store
        self._runs, self._emit, self._recording = runs, emit, recording
        self._clock = clock
        #: Offsets of mirror and loop.
        self.offsets: Callable[[], OffsetsState] = OffsetsState
        self._emit_lock = threading.Lock()
        self._last: tuple[float, Frame | None] = (0.0, None)
        self._rate, self._lost, self._counted_frames = 0.0, 0, 0
        self._clipped: deque[tuple[float, int, int]] = deque()
        self._thread: BackgroundThread | None = None

    def start(self, on_failure: Callable[[Exception], object]) -> None:
        """Publish periodically until :meth:`stop`; ``on_failure`` is called if the thread ends before."""
        self._thread = BackgroundThread("state", self.publish, PUBLISH_PERIOD_S, on_failure)
        self._thread.start()

    def stop(self) -> None:
        """Stop the thread and publish a last time."""
        if self._thread is not None:
            self._thread.stop(timeout_s=2)
        self.publish()

    def publish(self) -> None:
        """Publish the state now; from any thread, never an older state after a newer one."""
        try:
            with self._emit_lock:
                self._emit(self.state())
        except Exception:
            # A value that is not available must not be taken for a failed engine.
            log.exception("the state could not be published")

    def state(self) -> State:
        """Collect the state; the front end adds lease, clients and its own process."""
        now, bench, publisher = self._engine_state.snapshot, self._bench, self._publisher
        frame = publisher.latest_frame
        illumination = Illumination()
        if frame is not None and bench.wfs.is_open:
            peak = float(frame.data.max()) / bench.wfs.info.full_scale
            illumination = Illumination(saturated=frame.n_saturated / frame.data.size, peak=peak)
        return State(
            at_utc=format_utc(), engine_pid=os.getpid(), version=get_software_version(),
            system=bench.config.system.name, simulated=bench.simulated, seed=bench.config.system.seed,
            phase=now.phase, fault=now.fault, devices=device_states(bench, now.device_messages),
            rates=self._frame_counters(frame, now), mirror=self._mirror(), loop=self._loop(now),
            latency=_latency(now.loop_statistics),
            active_run=now.active_run, last_run=now.last_run, products=self._product_store.products,
            recording=self._recording(), offsets=self.offsets(), disk=self._disk(), streams=publisher.entries,
            geometry_version=publisher.geometry_version, illumination=illumination,
        )  # fmt: skip

    def _loop(self, now: EngineSnapshot) -> LoopState:
        loop, residual = now.loop, self._publisher.residual_nm
        n_modes = max(0, self._bench.config.basis.n_modes - loop.dropped_modes)
        return LoopState(
            closed=now.loop_closed, matrix=loop.matrix, gain=loop.gain, leak=loop.leak,
            dropped_modes=loop.dropped_modes, n_modes=n_modes,
            residual_nm=residual if now.loop_closed and math.isfinite(residual) else 0.0,
            strehl=_finite_metric(now.loop_statistics, "strehl"),
            strehl_sigma=_finite_metric(now.loop_statistics, "strehl_sigma"),
        )  # fmt: skip

    def _frame_counters(self, frame: Frame | None, engine: EngineSnapshot) -> FrameCounters:
        now, (at, before), frames = self._clock(), self._last, self._publisher.frames
        if frame is not None and now - at > _RATE_S:
            self._last = (now, frame)
            self._rate = 0.0 if before is None else _rate(before, frame)
        # Frames that are skipped while nothing runs do not count as lost.
        if engine.loop_control is not None:
            self._lost = int(engine.loop_statistics.get("lost", 0.0))
        elif engine.active_run is not None and self._bench.wfs.is_open and frames > self._counted_frames:
            # A procedure that does not read the sensor, such as the model PSF, loses no frames.
            self._lost = self._bench.wfs.status().lost
        self._counted_frames = frames
        return FrameCounters(frame_hz=self._rate, frames=frames, lost_frames=self._lost)

    def _mirror(self) -> MirrorState:
        dm, command = self._bench.dm, self._publisher.latest_command
        if command is None or not dm.is_open:
            return MirrorState()
        now = self._clock()
        self._clipped.append((now, dm.clipped_count, dm.sent_count))
        # The oldest count that is kept is the newest of those older than the averaging time.
        while len(self._clipped) > 2 and now - self._clipped[1][0] >= _CLIPPED_S:
            self._clipped.popleft()
        _, clipped, sent = (b - a for a, b in zip(self._clipped[0], self._clipped[-1], strict=True))
        return MirrorState(
            rms=root_mean_square(command),
            peak=float(np.abs(command).max(initial=0.0)),
            saturated_share=clipped / (sent * command.size) if sent > 0 else 0.0,
            flatten_count=dm.flatten_count,
        )

    def _disk(self) -> DiskState:
        folder = next(one for one in (self._runs, *self._runs.parents) if one.exists())
        return DiskState(folder=str(self._runs), free_gb=shutil.disk_usage(folder).free / 1e9)


def _rate(before: Frame, frame: Frame) -> float:
    """Frames per second between two frames, by the camera's clock and frame index."""
    elapsed = (frame.exposed_ns - before.exposed_ns) * 1e-9
    return (frame.index - before.index) / elapsed if elapsed > 0 and frame.index > before.index else 0.0


def _latency(metrics: Mapping[str, float]) -> LatencyState:
    names = {"p50": "latency_p50", "p99": "latency_p99", "max": "latency_max", "jitter_p99": "jitter_p99"}
    values = {key: metrics.get(name, math.nan) for key, name in names.items()}
    return LatencyState(**{key: value for key, value in values.items() if math.isfinite(value)})


def _finite_metric(metrics: Mapping[str, float], name: str) -> float | None:
    value = metrics.get(name, math.nan)
    return value if math.isfinite(value) else None


def device_states(bench: Bench, device_messages: Mapping[str, str]) -> tuple[DeviceState, ...]:
    """State of every device; ``device_messages`` holds their problems by name."""
    used = {
        name: "none" if image is None else "measured"
        for name, image in (("dark", bench.dark), ("flat", bench.flat))
    }
    return tuple(
        _device(name, kind, getattr(bench, name), device_messages, used if name == "wfs" else {})
        for name, kind in (
            ("dm", "deformable mirror"),
            ("wfs", "wavefront sensor camera"),
            ("modulator", "modulator"),
            ("science", "science camera"),
            ("screen", "phase screen"),
        )
        if getattr(bench, name) is not None
    )


def _device(
    name: str, kind: str, device: Device, device_messages: Mapping[str, str], facts: Mapping[str, str]
) -> DeviceState:
    message = device_messages.get(name, "")
    if not device.is_open:
        health = DeviceHealth.LOST if message else DeviceHealth.CLOSED
        return DeviceState(
            name=name, kind=kind, model="", serial="", simulated=False, health=health, message=message
        )
    info = device.info  # type: ignore[attr-defined]
    return DeviceState(
        name=name, kind=kind, model=info.model, serial=info.serial, simulated=bool(info.simulated),
        health=DeviceHealth.STALE if message else DeviceHealth.OK, facts={**_facts(device), **facts},
        message=message,
    )  # fmt: skip


def _facts(device: Device) -> dict[str, float | str]:
    info = device.info  # type: ignore[attr-defined]
    settings = getattr(device, "settings", None)
    if settings is not None:
        return {
            "frame_rate_hz": float(settings.frame_rate_hz),
            "exposure_ms": 1e3 * float(settings.exposure_s),
            "pixels": f"{settings.region.width} x {settings.region.height}",
        }
    if hasattr(info, "n_act"):
        return {"actuators": float(info.n_act), "stroke_um": 1e6 * float(info.stroke_m)}
    return {}


def geometry_of(bench: Bench, grid: SensorGeometry | None) -> Geometry:
    """Positions of the sub-apertures and actuators."""
    valid = () if grid is None else tuple("".join("1" if one else "0" for one in row) for row in grid.valid)
    stroke_m, science = float(bench.dm.info.stroke_m), bench.config.devices.science
    return Geometry(
        valid=valid,
        layout=actuator_layout(bench),
        positions_m=actuator_positions(bench),
        outlines_px=() if grid is None else grid.outlines(),
        n_modes=bench.config.basis.n_modes,
        stroke_m=stroke_m if math.isfinite(stroke_m) else 0.0,
        psf_px=0.0 if science is None else science.psf_px,
    )


def describe_recording(bench: Bench, engine: EngineSnapshot, store: ProductStore) -> RecordingDescription:
    """What an analysis of a recording needs to know about bench and loop."""
    loop = engine.loop
    known = {one.name: one.path for one in store.products}
    return RecordingDescription(
        system=bench.config.system.name, simulated=bench.simulated, started_utc=format_utc(),
        rate_hz=float(bench.wfs.settings.frame_rate_hz) if bench.wfs.is_open else 0.0,
        gain=loop.gain, leak=loop.leak, dropped_modes=loop.dropped_modes,
        matrix=known.get(loop.matrix, ""), loop_closed=engine.loop_closed,
        stroke_m=bench.config.devices.dm.stroke_m, max_stroke=bench.dm.limits.max_stroke,
    )  # fmt: skip
