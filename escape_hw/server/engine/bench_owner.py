"""Main thread of the engine: devices, safe state of the mirror, and a queue of jobs."""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections.abc import Callable, Mapping
from functools import cached_property
from queue import Empty, SimpleQueue
from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.procedure import Progress
from escape_hw.api.sensor import SlopeFunction
from escape_hw.bench import Bench
from escape_hw.calibration.acquisition.frames import ramp_to
from escape_hw.calibration.acquisition.sensor_setup import build_slope_function
from escape_hw.calibration.modes.bases import build_modal_basis
from escape_hw.errors import DeviceError, EscapeError, FrameTimeout
from escape_hw.remote.state import Phase
from escape_hw.server.engine.publisher import StreamPublisher
from escape_hw.server.engine.state import EngineState
from escape_hw.server.engine.state_publisher import StatePublisher

log = logging.getLogger(__name__)

#: Frames per second that are read while nothing runs.
IDLE_FRAME_RATE_HZ = 25.0
#: Longest wait for one of them, which delays a job.
_IDLE_TIMEOUT_S = 0.5
REOPEN_REMEDY = "Fix the device, then clear the fault to open the devices again."


class BenchOwner:
    """Owns the devices. All methods but those of the first group belong to the main thread.

    ``send`` sends a message to the front end.
    """

    def __init__(
        self,
        bench: Bench,
        state: EngineState,
        publisher: StreamPublisher,
        state_publisher: StatePublisher,
        send: Callable[[Mapping[str, Any]], object],
    ) -> None:
        self.bench, self.state, self.publisher = bench, state, publisher
        #: The configuration outside procedures, with the present settings of the cameras.
        self.config, self.config_changed = bench.config, False
        self.state_publisher, self.send = state_publisher, send
        self._jobs: SimpleQueue[Callable[[], object]] = SimpleQueue()
        self._flat_replies: list[Callable[[object], object]] = []
        self._flat_replies_lock = threading.Lock()
        #: Slope function while nothing runs, and what it was built from.
        self._slopes: tuple[tuple[object, ...], SlopeFunction | None] = ((), None)

    # ------------------------------------------------------------ any thread
    @cached_property
    def modal_basis(self) -> NDArray[np.float64]:
        """Modes to commands ``(n_act, n_modes)``."""
        return build_modal_basis(self.bench)

    def post(self, job: Callable[[], object]) -> None:
        """Queue a job for the main thread."""
        self._jobs.put(job)

    def reply_when_flat(self, reply: Callable[[object], object]) -> None:
        """Flatten the mirror after the present job, then call ``reply`` with the answer."""
        with self._flat_replies_lock:
            self._flat_replies.append(reply)
        self.post(self.flatten)

    def request_safe_state(self, reason: str, remedy: str = "Read the log, then clear the fault.") -> None:
        """Latch a fault, stop what runs, and make the mirror safe."""
        log.error("FAULT: %s", reason)
        self.state.latch_fault(reason, remedy)
        self.post(lambda: self.make_safe(reason, remedy))

    # ------------------------------------------------------------ jobs
    def run_next_job(self) -> None:
        """Run the next job, or read a frame when there is none. A defect in a job makes the mirror safe."""
        try:
            job = self._jobs.get(timeout=1 / IDLE_FRAME_RATE_HZ)
        except Empty:
            self.read_idle_frame()
            return
        try:
            job()
        except Exception as error:
            self.report_defect(error)

    def report_defect(self, error: Exception) -> None:
        """Log an unexpected exception with its traceback and make the mirror safe."""
        log.error("unexpected exception", exc_info=error)
        self.make_safe(f"{type(error).__name__}: {error} (this is a defect of ESCAPE)", "See the log.")

    def read_idle_frame(self) -> None:
        """Read a frame, and compute its slopes when the sensor's geometry is known."""
        bench = self.bench
        if not bench.wfs.is_open:
            return
        try:
            frame = bench.wfs.next_frame(_IDLE_TIMEOUT_S)
            self.state.set_device_message("wfs")
            if bench.science is not None:
                bench.science.poll()
        except FrameTimeout as error:
            self.state.set_device_message("wfs", str(error))
            return
        except DeviceError as error:
            if self.state.snapshot.fault is None:
                self.make_safe(str(error), REOPEN_REMEDY, error.device)
            return
        grid = self.publisher.grid
        if grid is not None:
            parts = (grid, bench.dark, bench.flat)
            if list(map(id, self._slopes[0])) != list(map(id, parts)):
                self._slopes = (parts, build_slope_function(bench, grid))
            if self._slopes[1] is not None:
                self._slopes[1](frame.data)

    # ------------------------------------------------------------ devices
    def open(self) -> None:
        """Open the devices and flatten the mirror; a failure is latched as a fault."""
        self.state.set_phase(Phase.STARTING)
        bench = self.bench
        try:
            bench.open()
            self._restore_camera_settings()
            science = None if bench.science is None else bench.science.info.full_scale
            self.publisher.set_full_scale(bench.wfs.info.full_scale, science)
            bench.callbacks = self.publisher.callbacks
            bench.dm.flatten()
        except EscapeError as error:
            self.make_safe(str(error), REOPEN_REMEDY, error.device)
            return
        self.state.set_phase(Phase.IDLE)
        log.info("%s: %d devices open, mirror flat", bench.config.system.name, len(bench.devices))

    def _restore_camera_settings(self) -> None:
        """Apply the settings that were chosen before the devices were closed."""
        for camera, section in (
            (self.bench.wfs, self.config.devices.wfs), (self.bench.science, self.config.devices.science),
        ):  # fmt: skip
            if self.config_changed and camera is not None and section is not None:
                camera.configure(section.settings())

    def close(self) -> None:
        """Close the devices; the mirror is flat then.

        An exception passes: without a clean exit, the fail-safe process flattens the mirror.
        """
        try:
            self.bench.close()
            log.info("mirror flat, devices closed")
        except Exception as error:
            log.error("the devices did not close cleanly: %s", error)
            raise
        finally:
            self.state.set_phase(Phase.STOPPED)
            self.send_flat_replies()

    def clear_fault(self) -> None:
        """Release the fault and open the devices again."""
        self.state.clear_fault()
        with contextlib.suppress(EscapeError):
            # A device that does not close cleanly now was the fault itself; the bench has logged it.
            self.bench.close()
        self.open()

    def flatten(self) -> None:
        """Ramp the mirror flat and answer those who wait for it."""
        if self.bench.dm.is_open:
            try:
                self.bench.dm.flatten()
            except DeviceError as error:
                self.make_safe(
                    str(error),
                    "The mirror cannot be flattened from here. Switch its power off if needed.",
                    error.device,
                )
        self.send_flat_replies()

    def send_flat_replies(self) -> None:
        """Answer those who wait for a flat mirror: the fault's reason, or ``None`` when it is flat."""
        with self._flat_replies_lock:
            waiting, self._flat_replies = self._flat_replies, []
        if waiting:
            self.state_publisher.publish()
        fault = self.state.snapshot.fault
        for reply in waiting:
            reply({"fault": None if fault is None else fault.reason})

    def make_safe(self, reason: str, remedy: str, device: str = "") -> None:
        """Latch a fault, flatten the mirror as far as possible, and close ``device``, which failed."""
        self.state.enter_fault(reason, remedy)
        log.error("FAULT: %s", reason)
        dm = self.bench.dm
        try:
            # The mirror itself may have failed.
            if dm.is_open:
                dm.flatten()
        except EscapeError as error:
            log.error("the mirror could NOT be made flat: %s", error)
        # A failed device is closed, so that it can be opened again.
        for failed in self.bench.devices:
            if failed.is_open and failed is not dm and failed.name == device:
                try:
                    failed.close()
                except Exception as error:
                    log.error("%s did not close cleanly: %s", device, error)
                self.state.set_device_message(device, reason)

    # ------------------------------------------------------------ while a procedure or the loop runs
    def observe(self, progress: Progress) -> None:
        """Publish the progress of what runs, and pause when requested."""
        run = self.state.update_progress(progress)
        if run is not None:
            self.send({"progress": run.model_dump(mode="json")})
        if progress.arrays:
            self.publisher.publish_arrays(progress.arrays, stage=progress.stage, done=float(progress.done))
        if self.state.snapshot.paused:
            self._pause_until_resumed()

    def _pause_until_resumed(self) -> None:
        """Wait with a flat mirror until the procedure may resume; then restore the mirror's shape."""
        dm = self.bench.dm
        shape = dm.shape
        dm.flatten()
        log.info("paused, mirror flat")
        self.state.mark_run_paused(True)
        while self.state.snapshot.paused and not self.state.stop_requested:
            time.sleep(0.02)
        self.state.mark_run_paused(False)
        if not self.state.stop_requested:
            ramp_to(dm, shape)
            log.info("resumed")
