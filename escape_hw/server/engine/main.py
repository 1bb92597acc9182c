"""The engine: the process that owns the devices, runs the loop and the procedures."""

from __future__ import annotations

import contextlib
import logging
import math
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable
from queue import Empty, SimpleQueue
from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.procedure import Progress
from escape_hw.calibration.acquisition.frames import ramp_to
from escape_hw.calibration.acquisition.sensor_setup import build_slope_function
from escape_hw.config.loader import load_text
from escape_hw.errors import DeviceError, EscapeError, FrameTimeout
from escape_hw.remote.state import Phase, State
from escape_hw.runtime.session.system import System
from escape_hw.server.engine.planning import ProcedurePlanner
from escape_hw.server.engine.procedures import ProcedureRegistry
from escape_hw.server.engine.product_store import ProductStore
from escape_hw.server.engine.publisher import StreamPublisher
from escape_hw.server.engine.recording import TelemetryRecording
from escape_hw.server.engine.request_handler import RequestHandler
from escape_hw.server.engine.state import EngineState, LoopSettings
from escape_hw.server.engine.state_publisher import StatePublisher
from escape_hw.server.ipc.channel import Channel, EngineSetup
from escape_hw.server.ipc.log import LogForwarder

# Run as a program it would be called otherwise, and nobody would hear it.
log = logging.getLogger("escape_hw.server.engine.main")

#: Frames per wall-clock second that are looked at while nothing runs.
IDLE_FRAME_RATE_HZ = 25.0
#: Longest wait for one of them; what is asked of the engine waits as long.
_WATCH_TIMEOUT_S = 0.5

Job = Callable[[], object]


class Engine:
    """Owns a bench. Its main thread does one job after the other and watches frames between them.

    Parameters
    ----------
    channel
        To the front.
    setup
        The front's orders.
    """

    def __init__(self, channel: Channel, setup: EngineSetup) -> None:
        self.channel, self.setup = channel, setup
        self.config = load_text(setup.config_text)
        self.engine_state = EngineState(LoopSettings.from_config(self.config))
        self.bench = System.from_config(self.config)
        self.publisher = StreamPublisher(self.config.system.name)
        self.product_store = ProductStore((setup.runs, *setup.reads))
        self.procedures = ProcedureRegistry(self.config)
        self.planner = ProcedurePlanner(self.bench)
        self.next_run = setup.first_run
        #: What an image without turbulence looks like, once it was measured.
        self.model_psf: NDArray[np.float32] | None = None
        self._jobs: SimpleQueue[Job] = SimpleQueue()
        self._flat_replies: list[int] = []
        self._flat_replies_lock = threading.Lock()
        self._stopping = threading.Event()
        self._slopes: tuple[object, Any] = (None, None)
        self.telemetry = TelemetryRecording(setup.runs, self.publisher)
        self.state_publisher = StatePublisher(
            self.bench, self.engine_state, self.publisher, self.product_store, setup.runs, self._send_state,
            self.telemetry.state,
        )  # fmt: skip

    # ------------------------------------------------------------ for other threads
    def post(self, job: Job) -> None:
        """Give the main thread something to do."""
        self._jobs.put(job)

    def reply_when_flat(self, reply: int) -> None:
        """Answer a request as soon as the mirror is flat and nothing moves it."""
        with self._flat_replies_lock:
            self._flat_replies.append(reply)
        self.post(self.flatten)

    def request_stop(self) -> None:
        """Stop whatever runs and end."""
        self._stopping.set()
        self.engine_state.stop.set()
        self.post(lambda: None)

    # ------------------------------------------------------------ main thread
    def run(self, request_handler: RequestHandler) -> None:
        """Live until told to end; the mirror ends flat."""
        self.state_publisher.start()
        request_handler.start()
        try:
            self.open()
            while not self._stopping.is_set():
                self._run_next_job()
        finally:
            self._close()

    def open(self) -> None:
        """Open the devices, mirror flat; a failure is latched as a fault."""
        self.engine_state.phase = Phase.STARTING
        try:
            self.bench.open()
            self.publisher.top = self.bench.wfs.info.full_scale
            self.bench.callbacks = self.publisher.callbacks
            self.bench.dm.flatten()
            self.engine_state.device_messages.clear()
            self.engine_state.phase = Phase.IDLE
            log.info("%s: %d devices open, mirror flat", self.config.system.name, len(self.bench.devices))
        except EscapeError as error:
            self.make_safe(str(error), "mend it, then clear the fault to open the devices again")

    def _close(self) -> None:
        try:
            self.bench.close()
            log.info("mirror flat, devices closed")
        except Exception as error:
            # It ends all the same; the guardian, who has heard no goodbye then, tries again.
            log.error("the devices did not close cleanly: %s", error)
            raise
        finally:
            self.engine_state.phase = Phase.STOPPED
            self.send_flat_replies()
            self.telemetry.set_recording(on=False)
            self.state_publisher.stop()
            self.publisher.close()

    def _run_next_job(self) -> None:
        """One job, or one frame."""
        try:
            job = self._jobs.get(timeout=1 / IDLE_FRAME_RATE_HZ)
        except Empty:
            self._read_idle_frame()
            return
        try:
            job()
        except Exception as error:
            log.exception("unexpected")
            self.make_safe(f"{type(error).__name__}: {error} (this is a defect of ESCAPE)", "see the log")

    def _read_idle_frame(self) -> None:
        """Look at a frame, and its slopes when the sensor is known."""
        bench, engine_state = self.bench, self.engine_state
        if not bench.wfs.is_open:
            return
        try:
            frame = bench.wfs.next_frame(_WATCH_TIMEOUT_S)
            engine_state.device_messages.pop("wfs", None)
            if bench.science is not None:
                bench.science.poll()
        except FrameTimeout as error:
            engine_state.device_messages["wfs"] = str(error)
            return
        except DeviceError as error:
            if engine_state.fault is None:
                self.make_safe(str(error), "mend it, then clear the fault to open the devices again")
            return
        grid = self.publisher.grid
        if grid is not None:
            if self._slopes[0] is not grid:
                self._slopes = (grid, build_slope_function(bench, grid))
            self._slopes[1](frame.data)

    def flatten(self) -> None:
        """Ramp the mirror flat, and tell those who wait for it."""
        if self.bench.dm.is_open:
            try:
                self.bench.dm.flatten()
            except DeviceError as error:
                self.make_safe(
                    str(error), "the mirror cannot be flattened from here: cut its power if in doubt"
                )
        self.send_flat_replies()

    def make_safe(self, reason: str, way_out: str) -> None:
        """Flatten as far as possible, and latch the fault."""
        self.engine_state.latch_fault(reason, way_out)
        self.engine_state.phase, self.engine_state.closed = Phase.FAULT, False
        log.error("FAULT: %s", reason)
        dm = self.bench.dm
        with contextlib.suppress(EscapeError):
            # The reason that counts is latched already, and the mirror may be what failed.
            if dm.is_open:
                dm.flatten()
        # Lost devices are let go, so that they can be opened again.
        for device in self.bench.devices:
            if device.is_open and device is not dm and reason.startswith(f"{device.name}:"):
                with contextlib.suppress(Exception):
                    device.close()
                self.engine_state.device_messages[device.name] = reason

    def clear_fault(self) -> None:
        """Open closed devices again, and be ready."""
        self.engine_state.fault = None
        with contextlib.suppress(EscapeError):
            # What does not close cleanly now was the fault itself.
            self.bench.close()
        self.open()

    def send_flat_replies(self) -> None:
        """Tell those who wait for a flat mirror that it is, or why not."""
        with self._flat_replies_lock:
            waiting, self._flat_replies = self._flat_replies, []
        if waiting:
            self.state_publisher.publish()
        fault = self.engine_state.fault
        for reply in waiting:
            self.channel.post({"reply": reply, "answer": {"fault": None if fault is None else fault.reason}})

    def pause_until_resumed(self) -> None:
        """Wait, mirror flat, until the procedure may go on; the shape it had comes back then."""
        engine_state, dm = self.engine_state, self.bench.dm
        shape = dm.shape
        dm.flatten()
        log.info("halted, mirror flat")
        if engine_state.running is not None:
            engine_state.running = engine_state.running.model_copy(update={"paused": True})
        while engine_state.paused and not engine_state.stop.is_set():
            time.sleep(0.02)
        if engine_state.running is not None:
            engine_state.running = engine_state.running.model_copy(update={"paused": False})
        if not engine_state.stop.is_set():
            ramp_to(dm, shape)
            log.info("going on")

    def observe(self, progress: Progress) -> None:
        """Tell how far what runs is, and halt when asked."""
        engine_state, running = self.engine_state, self.engine_state.running
        if engine_state.loop_control is not None:
            engine_state.loop_statistics = dict(progress.metrics)
        elif running is not None:
            left = progress.remaining_s
            engine_state.running = running.model_copy(
                update={
                    "stage": progress.stage, "done": progress.done, "total": progress.total,
                    "unit": progress.unit, "elapsed_s": progress.elapsed_s,
                    "remaining_s": left if math.isfinite(left) else None,
                    "metrics": {k: float(v) for k, v in progress.metrics.items() if math.isfinite(v)},
                }
            )  # fmt: skip
            self.channel.post({"progress": engine_state.running.model_dump(mode="json")})
        if progress.arrays:
            self.publisher.arrays(progress.arrays, stage=progress.stage, done=float(progress.done))
        if engine_state.paused:
            self.pause_until_resumed()

    def _send_state(self, state: State) -> None:
        self.channel.post({"state": state.model_dump(mode="json")})


def _forward_log(channel: Channel) -> None:
    handler = LogForwarder(lambda line: channel.post({"log": line.model_dump(mode="json")}))
    for name in ("escape_hw", "escape_sim", "escape_drivers"):
        logging.getLogger(name).addHandler(handler)
    logging.getLogger("escape_hw").setLevel(logging.INFO)


def main() -> None:
    """Run an engine: ``argv`` holds the descriptors of the channel and of the guardian's pipe."""
    # A Ctrl-C on the terminal is the front's business.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    descriptor, failsafe_pipe = (int(word) for word in sys.argv[1:3])
    channel = Channel(socket.socket(fileno=descriptor))
    messages = channel.messages()
    setup = EngineSetup.model_validate(next(messages))
    _forward_log(channel)
    engine = Engine(channel, setup)
    clean = False
    try:
        engine.run(RequestHandler(engine, messages))
        clean = True
    finally:
        if clean:
            # The goodbye: the mirror is flat and nobody needs to do it again.
            os.write(failsafe_pipe, b"bye")
            channel.post({"goodbye": True})
        channel.close()


if __name__ == "__main__":
    main()
