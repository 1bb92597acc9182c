"""The engine's state, five times a second, whatever its main thread is doing."""

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
from typing import TYPE_CHECKING

import numpy as np

from escape_hw.io.provenance import format_utc, get_software_version
from escape_hw.remote.state import (
    DiskState,
    FrameCounters,
    LatencyState,
    LoopState,
    MirrorState,
    RecordingState,
    State,
)
from escape_hw.server.engine.bench_status import device_states, illumination_of
from escape_hw.server.engine.product_store import ProductStore
from escape_hw.server.engine.publisher import StreamPublisher
from escape_hw.server.engine.state import EngineState

if TYPE_CHECKING:
    from escape_hw.api.camera import Frame
    from escape_hw.bench import Bench

log = logging.getLogger(__name__)

PUBLISH_PERIOD_S = 0.2
#: Seconds over which the share of clipped actuators is averaged.
_CLIPPED_S = 1.0
#: Time over which the camera's rate is taken; longer than a frame may need while nothing runs.
_RATE_S = 0.5


class StatePublisher:
    """Tells the state, in a thread of its own.

    Parameters
    ----------
    bench
        The bench; its devices are asked for what they remember, never for anything new.
    tell
        Gets each state.
    telemetry
        What the recorder says.
    clock
        Monotonic seconds.
    """

    def __init__(
        self,
        bench: Bench,
        engine_state: EngineState,
        publisher: StreamPublisher,
        product_store: ProductStore,
        runs: Path,
        emit: Callable[[State], object],
        telemetry: Callable[[], RecordingState] = RecordingState,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._bench, self._engine_state, self._publisher, self._product_store = (
            bench,
            engine_state,
            publisher,
            product_store,
        )
        self._runs, self._emit, self._telemetry = runs, emit, telemetry
        self._clock = clock
        self._ending, self._emit_lock = threading.Event(), threading.Lock()
        self._last: tuple[float, Frame | None] = (0.0, None)
        self._rate, self._lost = 0.0, 0
        self._clipped: deque[tuple[float, int, int]] = deque()
        self._thread = threading.Thread(target=self._run, name="pulse", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def stop(self) -> None:
        """Tell the state a last time, and end."""
        self._ending.set()
        self._thread.join(timeout=2)

    def _run(self) -> None:
        while not self._ending.wait(PUBLISH_PERIOD_S):
            self.publish()
        self.publish()

    def publish(self) -> None:
        """Tell the state now; from any thread, and never an older one after a newer one."""
        try:
            with self._emit_lock:
                self._emit(self.state())
        except Exception:
            # A number that cannot be had must not be taken for an engine that is dead.
            log.exception("the state could not be told")

    def state(self) -> State:
        """The state as far as the engine knows it."""
        engine_state, bench, publisher = self._engine_state, self._bench, self._publisher
        loop, residual = engine_state.loop, publisher.residual_nm
        frame = publisher.frame
        light = {} if frame is None or not bench.wfs.is_open else {
            "light": illumination_of(frame, bench.wfs.info.full_scale)
        }  # fmt: skip
        return State(
            at_utc=format_utc(), engine_pid=os.getpid(), version=get_software_version(),
            system=bench.config.system.name, simulated=bench.simulated, seed=bench.config.system.seed,
            phase=engine_state.phase, fault=engine_state.fault, devices=device_states(bench, dict(engine_state.device_messages)),
            rates=self._rates(frame), mirror=self._mirror(), latency=_latency(engine_state.loop_statistics),
            loop=LoopState(
                closed=engine_state.closed, matrix=loop.matrix, gain=loop.gain, leak=loop.leak,
                dropped_modes=loop.dropped_modes, modes=bench.config.basis.n_modes,
                residual_nm=residual if engine_state.closed and math.isfinite(residual) else 0.0,
                strehl=_finite_metric(engine_state.loop_statistics, "strehl"),
                strehl_sigma=_finite_metric(engine_state.loop_statistics, "strehl_sigma"),
            ),
            procedure=engine_state.running, last=engine_state.last, products=self._product_store.products,
            telemetry=self._telemetry(), disk=self._disk(), streams=publisher.entries,
            geometries=publisher.geometries, **light,
        )  # fmt: skip

    def _rates(self, frame: Frame | None) -> FrameCounters:
        now, (at, before) = self._clock(), self._last
        if frame is not None and now - at > _RATE_S:
            self._last = (now, frame)
            self._rate = 0.0 if before is None else _rate(before, frame)
        return FrameCounters(frame_hz=self._rate, frames=self._publisher.frames, lost=self._lost_frames())

    def _lost_frames(self) -> int:
        """Frames lost; those that pass while the engine only looks now and then, nobody wanted."""
        engine_state, wfs = self._engine_state, self._bench.wfs
        if engine_state.loop_control is not None:
            self._lost = int(engine_state.loop_statistics.get("lost", 0.0))
        elif engine_state.running is not None and wfs.is_open:
            self._lost = wfs.status().lost
        return self._lost

    def _mirror(self) -> MirrorState:
        dm, command = self._bench.dm, self._publisher.command
        if command is None or not dm.is_open:
            return MirrorState()
        now = self._clock()
        self._clipped.append((now, dm.clipped_count, dm.sent_count))
        # The one kept longest is the newest that is a second old.
        while len(self._clipped) > 2 and now - self._clipped[1][0] >= _CLIPPED_S:
            self._clipped.popleft()
        _, clipped, sent = (b - a for a, b in zip(self._clipped[0], self._clipped[-1], strict=True))
        return MirrorState(
            rms=float(np.sqrt(np.mean(np.square(command)))),
            peak=float(np.abs(command).max(initial=0.0)),
            clipped=clipped / (sent * command.size) if sent > 0 else 0.0,
            flattened=dm.flatten_count,
        )

    def _disk(self) -> DiskState:
        folder = next(one for one in (self._runs, *self._runs.parents) if one.exists())
        return DiskState(folder=str(self._runs), free_gb=shutil.disk_usage(folder).free / 1e9)


def _rate(before: Frame, frame: Frame) -> float:
    """Frames per second between two of them, by their own clock."""
    elapsed = (frame.exposed_ns - before.exposed_ns) * 1e-9
    return (frame.index - before.index) / elapsed if elapsed > 0 and frame.index > before.index else 0.0


def _latency(metrics: Mapping[str, float]) -> LatencyState:
    """What a loop that stays closed tells of its times; NaN while it has none."""
    names = {"p50": "latency_p50", "p99": "latency_p99", "largest": "latency_max", "jitter_p99": "jitter_p99"}
    known = {key: metrics.get(name, math.nan) for key, name in names.items()}
    return LatencyState(**{key: value for key, value in known.items() if math.isfinite(value)})


def _finite_metric(metrics: Mapping[str, float], name: str) -> float | None:
    value = metrics.get(name, math.nan)
    return value if math.isfinite(value) else None
