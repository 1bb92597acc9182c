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
from escape_hw.calibration.acquire import go_to
from escape_hw.calibration.sensor_setup import extractor
from escape_hw.config.load import load_text
from escape_hw.errors import DeviceError, EscapeError, FrameTimeout
from escape_hw.remote.state import Phase, State
from escape_hw.runtime.system import System
from escape_hw.server.board import Board, LoopChoice
from escape_hw.server.channel import Channel
from escape_hw.server.desk import Desk
from escape_hw.server.offers import Offers
from escape_hw.server.plans import Planner
from escape_hw.server.publisher import Publisher
from escape_hw.server.pulse import Pulse
from escape_hw.server.setup import Setup
from escape_hw.server.shelf import Shelf
from escape_hw.server.telemetry import Switch
from escape_hw.server.wire_log import WireLog

# Run as a program it would be called otherwise, and nobody would hear it.
log = logging.getLogger("escape_hw.server.engine")

#: Frames per wall-clock second that are looked at while nothing runs.
WATCH_HZ = 25.0
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

    def __init__(self, channel: Channel, setup: Setup) -> None:
        self.channel, self.setup = channel, setup
        self.config = load_text(setup.config_text)
        self.board = Board(LoopChoice.configured(self.config))
        self.bench = System.from_config(self.config)
        self.publisher = Publisher(self.config.system.name)
        self.shelf = Shelf((setup.runs, *setup.reads))
        self.offers = Offers(self.config)
        self.planner = Planner(self.bench)
        self.next_run = setup.first_run
        #: What an image without turbulence looks like, once it was measured.
        self.model_psf: NDArray[np.float32] | None = None
        self._jobs: SimpleQueue[Job] = SimpleQueue()
        self._flat: list[int] = []
        self._flat_lock = threading.Lock()
        self._ending = threading.Event()
        self._slopes: tuple[object, Any] = (None, None)
        self.telemetry = Switch(setup.runs, self.publisher)
        self.pulse = Pulse(
            self.bench, self.board, self.publisher, self.shelf, setup.runs, self._tell_state,
            self.telemetry.state,
        )  # fmt: skip

    # ------------------------------------------------------------ for other threads
    def post(self, job: Job) -> None:
        """Give the main thread something to do."""
        self._jobs.put(job)

    def when_flat(self, reply: int) -> None:
        """Answer a request as soon as the mirror is flat and nothing moves it."""
        with self._flat_lock:
            self._flat.append(reply)
        self.post(self.flatten)

    def end(self) -> None:
        """Stop whatever runs and end."""
        self._ending.set()
        self.board.stop.set()
        self.post(lambda: None)

    # ------------------------------------------------------------ main thread
    def run(self, desk: Desk) -> None:
        """Live until told to end; the mirror ends flat."""
        self.pulse.start()
        desk.start()
        try:
            self.open()
            while not self._ending.is_set():
                self._turn()
        finally:
            self._close()

    def open(self) -> None:
        """Open the devices, mirror flat; a failure is latched as a fault."""
        self.board.phase = Phase.STARTING
        try:
            self.bench.open()
            self.publisher.top = self.bench.wfs.info.full_scale
            self.bench.taps = self.publisher.taps
            self.bench.dm.flatten()
            self.board.complaints.clear()
            self.board.phase = Phase.IDLE
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
            self.board.phase = Phase.STOPPED
            self.answer_flat()
            self.telemetry.turn(on=False)
            self.pulse.stop()
            self.publisher.close()

    def _turn(self) -> None:
        """One job, or one frame."""
        try:
            job = self._jobs.get(timeout=1 / WATCH_HZ)
        except Empty:
            self._watch()
            return
        try:
            job()
        except Exception as error:
            log.exception("unexpected")
            self.make_safe(f"{type(error).__name__}: {error} (this is a defect of ESCAPE)", "see the log")

    def _watch(self) -> None:
        """Look at a frame, and its slopes when the sensor is known."""
        bench, board = self.bench, self.board
        if not bench.wfs.is_open:
            return
        try:
            frame = bench.wfs.next_frame(_WATCH_TIMEOUT_S)
            board.complaints.pop("wfs", None)
            if bench.science is not None:
                bench.science.poll()
        except FrameTimeout as error:
            board.complaints["wfs"] = str(error)
            return
        except DeviceError as error:
            if board.fault is None:
                self.make_safe(str(error), "mend it, then clear the fault to open the devices again")
            return
        grid = self.publisher.grid
        if grid is not None:
            if self._slopes[0] is not grid:
                self._slopes = (grid, extractor(bench, grid))
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
        self.answer_flat()

    def make_safe(self, reason: str, way_out: str) -> None:
        """Flatten as far as possible, and latch the fault."""
        self.board.latch(reason, way_out)
        self.board.phase, self.board.closed = Phase.FAULT, False
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
                self.board.complaints[device.name] = reason

    def clear_fault(self) -> None:
        """Open closed devices again, and be ready."""
        self.board.fault = None
        with contextlib.suppress(EscapeError):
            # What does not close cleanly now was the fault itself.
            self.bench.close()
        self.open()

    def answer_flat(self) -> None:
        """Tell those who wait for a flat mirror that it is, or why not."""
        with self._flat_lock:
            waiting, self._flat = self._flat, []
        if waiting:
            self.pulse.beat()
        fault = self.board.fault
        for reply in waiting:
            self.channel.post({"reply": reply, "answer": {"fault": None if fault is None else fault.reason}})

    def halt(self) -> None:
        """Wait, mirror flat, until the procedure may go on; the shape it had comes back then."""
        board, dm = self.board, self.bench.dm
        shape = dm.shape
        dm.flatten()
        log.info("halted, mirror flat")
        if board.running is not None:
            board.running = board.running.model_copy(update={"paused": True})
        while board.paused and not board.stop.is_set():
            time.sleep(0.02)
        if board.running is not None:
            board.running = board.running.model_copy(update={"paused": False})
        if not board.stop.is_set():
            go_to(dm, shape)
            log.info("going on")

    def observe(self, progress: Progress) -> None:
        """Tell how far what runs is, and halt when asked."""
        board, running = self.board, self.board.running
        if board.orders is not None:
            board.loop_metrics = dict(progress.metrics)
        elif running is not None:
            left = progress.remaining_s
            board.running = running.model_copy(
                update={
                    "stage": progress.stage, "done": progress.done, "total": progress.total,
                    "unit": progress.unit, "elapsed_s": progress.elapsed_s,
                    "remaining_s": left if math.isfinite(left) else None,
                    "metrics": {k: float(v) for k, v in progress.metrics.items() if math.isfinite(v)},
                }
            )  # fmt: skip
            self.channel.post({"progress": board.running.model_dump(mode="json")})
        if progress.arrays:
            self.publisher.arrays(progress.arrays, stage=progress.stage, done=float(progress.done))
        if board.paused:
            self.halt()

    def _tell_state(self, state: State) -> None:
        self.channel.post({"state": state.model_dump(mode="json")})


def _log_to(channel: Channel) -> None:
    handler = WireLog(lambda line: channel.post({"log": line.model_dump(mode="json")}))
    for name in ("escape_hw", "escape_sim", "escape_drivers"):
        logging.getLogger(name).addHandler(handler)
    logging.getLogger("escape_hw").setLevel(logging.INFO)


def main() -> None:
    """Run an engine: ``argv`` holds the descriptors of the channel and of the guardian's pipe."""
    # A Ctrl-C on the terminal is the front's business.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    descriptor, guardian = (int(word) for word in sys.argv[1:3])
    channel = Channel(socket.socket(fileno=descriptor))
    messages = channel.messages()
    setup = Setup.model_validate(next(messages))
    _log_to(channel)
    engine = Engine(channel, setup)
    clean = False
    try:
        engine.run(Desk(engine, messages))
        clean = True
    finally:
        if clean:
            # The goodbye: the mirror is flat and nobody needs to do it again.
            os.write(guardian, b"bye")
            channel.post({"goodbye": True})
        channel.close()


if __name__ == "__main__":
    main()
