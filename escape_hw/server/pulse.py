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

from escape_hw.io.provenance import software_version, utc_text
from escape_hw.remote.state import (
    Disk,
    Latency,
    LoopState,
    Mirror,
    Rates,
    State,
    Telemetry,
)
from escape_hw.server.board import Board
from escape_hw.server.publisher import Publisher
from escape_hw.server.shelf import Shelf
from escape_hw.server.views import device_states, light_of

if TYPE_CHECKING:
    from escape_hw.api.frames import Frame
    from escape_hw.bench import Bench

log = logging.getLogger(__name__)

PERIOD_S = 0.2
#: Seconds over which the share of clipped actuators is averaged.
_CLIPPED_S = 1.0
#: Time over which the camera's rate is taken; longer than a frame may need while nothing runs.
_RATE_S = 0.5


class Pulse:
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
        board: Board,
        publisher: Publisher,
        shelf: Shelf,
        runs: Path,
        tell: Callable[[State], object],
        telemetry: Callable[[], Telemetry] = Telemetry,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._bench, self._board, self._publisher, self._shelf = bench, board, publisher, shelf
        self._runs, self._tell, self._telemetry = runs, tell, telemetry
        self._clock = clock
        self._ending, self._telling = threading.Event(), threading.Lock()
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
        while not self._ending.wait(PERIOD_S):
            self.beat()
        self.beat()

    def beat(self) -> None:
        """Tell the state now; from any thread, and never an older one after a newer one."""
        try:
            with self._telling:
                self._tell(self.state())
        except Exception:
            # A number that cannot be had must not be taken for an engine that is dead.
            log.exception("the state could not be told")

    def state(self) -> State:
        """The state as far as the engine knows it."""
        board, bench, publisher = self._board, self._bench, self._publisher
        loop, residual = board.loop, publisher.residual_nm
        frame = publisher.frame
        light = {} if frame is None or not bench.wfs.is_open else {
            "light": light_of(frame, bench.wfs.info.full_scale)
        }  # fmt: skip
        return State(
            at_utc=utc_text(), engine_pid=os.getpid(), version=software_version(),
            system=bench.config.system.name, simulated=bench.simulated, seed=bench.config.system.seed,
            phase=board.phase, fault=board.fault, devices=device_states(bench, dict(board.complaints)),
            rates=self._rates(frame), mirror=self._mirror(), latency=_latency(board.loop_metrics),
            loop=LoopState(
                closed=board.closed, matrix=loop.matrix, gain=loop.gain, leak=loop.leak,
                dropped_modes=loop.dropped_modes, modes=bench.config.basis.n_modes,
                residual_nm=residual if board.closed and math.isfinite(residual) else 0.0,
                strehl=_known(board.loop_metrics, "strehl"),
                strehl_sigma=_known(board.loop_metrics, "strehl_sigma"),
            ),
            procedure=board.running, last=board.last, products=self._shelf.products,
            telemetry=self._telemetry(), disk=self._disk(), streams=publisher.entries,
            geometries=publisher.geometries, **light,
        )  # fmt: skip

    def _rates(self, frame: Frame | None) -> Rates:
        now, (at, before) = self._clock(), self._last
        if frame is not None and now - at > _RATE_S:
            self._last = (now, frame)
            self._rate = 0.0 if before is None else _rate(before, frame)
        return Rates(frame_hz=self._rate, frames=self._publisher.frames, lost=self._lost_now())

    def _lost_now(self) -> int:
        """Frames lost; those that pass while the engine only looks now and then, nobody wanted."""
        board, wfs = self._board, self._bench.wfs
        if board.orders is not None:
            self._lost = int(board.loop_metrics.get("lost", 0.0))
        elif board.running is not None and wfs.is_open:
            self._lost = wfs.status().lost
        return self._lost

    def _mirror(self) -> Mirror:
        dm, command = self._bench.dm, self._publisher.command
        if command is None or not dm.is_open:
            return Mirror()
        now = self._clock()
        self._clipped.append((now, dm.clipped_count, dm.sent_count))
        # The one kept longest is the newest that is a second old.
        while len(self._clipped) > 2 and now - self._clipped[1][0] >= _CLIPPED_S:
            self._clipped.popleft()
        _, clipped, sent = (b - a for a, b in zip(self._clipped[0], self._clipped[-1], strict=True))
        return Mirror(
            rms=float(np.sqrt(np.mean(np.square(command)))),
            peak=float(np.abs(command).max(initial=0.0)),
            clipped=clipped / (sent * command.size) if sent > 0 else 0.0,
            flattened=dm.flattened_count,
        )

    def _disk(self) -> Disk:
        folder = next(one for one in (self._runs, *self._runs.parents) if one.exists())
        return Disk(folder=str(self._runs), free_gb=shutil.disk_usage(folder).free / 1e9)


def _rate(before: Frame, frame: Frame) -> float:
    """Frames per second between two of them, by their own clock."""
    elapsed = (frame.exposed_ns - before.exposed_ns) * 1e-9
    return (frame.index - before.index) / elapsed if elapsed > 0 and frame.index > before.index else 0.0


def _latency(metrics: Mapping[str, float]) -> Latency:
    """What a loop that stays closed tells of its times; NaN while it has none."""
    names = {"p50": "latency_p50", "p99": "latency_p99", "largest": "latency_max", "jitter_p99": "jitter_p99"}
    known = {key: metrics.get(name, math.nan) for key, name in names.items()}
    return Latency(**{key: value for key, value in known.items() if math.isfinite(value)})


def _known(metrics: Mapping[str, float], name: str) -> float | None:
    value = metrics.get(name, math.nan)
    return value if math.isfinite(value) else None
