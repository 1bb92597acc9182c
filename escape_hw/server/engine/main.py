"""The engine process: owns the devices, runs the loop and the procedures."""

from __future__ import annotations

import os
import signal
import socket
import sys
import threading
from collections.abc import Iterator
from typing import Any

from escape_hw.config.loader import load_text
from escape_hw.io.run_folder import last_run_number
from escape_hw.remote.state import State
from escape_hw.runtime.session.system import System
from escape_hw.server.engine.bench_owner import BenchOwner
from escape_hw.server.engine.offsets import OffsetControl
from escape_hw.server.engine.product_store import ProductStore
from escape_hw.server.engine.publisher import StreamPublisher, TelemetryRecording
from escape_hw.server.engine.request_handler import RequestHandler
from escape_hw.server.engine.runner import LoopRunner, ProcedureRunner
from escape_hw.server.engine.state import EngineState, LoopParameters
from escape_hw.server.engine.state_publisher import StatePublisher, describe_recording
from escape_hw.server.ipc.channel import Channel, EngineSetup
from escape_hw.server.ipc.log import forward_log
from escape_hw.server.safety.failsafe import CLEAN_EXIT
from escape_hw.supervision import BackgroundThread


class Engine:
    """Composes the parts of the engine and runs its main loop."""

    def __init__(self, channel: Channel, setup: EngineSetup) -> None:
        self._channel, self._front_end_timeout_s = channel, setup.front_end_timeout_s
        self._stopping = threading.Event()
        self._failure: Exception | None = None
        config = load_text(setup.config_text)
        bench = System.from_config(config)
        # Names of runs and matrices are those of this folder, also of earlier servers.
        first_run_id = max(setup.first_run_id, last_run_number(setup.runs, config.system.name) + 1)
        state = self._state = EngineState(LoopParameters.from_config(config), first_run_id)
        publisher = self._publisher = StreamPublisher(config.system.name)
        store = ProductStore((setup.runs, *setup.read_folders), setup.products)
        recording = self._recording = TelemetryRecording(
            setup.runs, publisher, lambda: describe_recording(bench, state.snapshot, store)
        )
        state_publisher = self._state_publisher = StatePublisher(
            bench, state, publisher, store, setup.runs, self._send_state, recording.state
        )
        owner = self._owner = BenchOwner(bench, state, publisher, state_publisher, channel.post)
        offsets = OffsetControl(owner, setup.runs)
        state_publisher.offsets = lambda: offsets.state
        loop_runner = LoopRunner(owner, store, lambda: offsets.offsets)
        procedure_runner = ProcedureRunner(owner, loop_runner, store, runs=setup.runs)
        self._request_handler = RequestHandler(
            owner, loop_runner, procedure_runner, store, recording, self.request_stop, offsets
        )

    def request_stop(self) -> None:
        """Stop what runs and end; from any thread."""
        self._stopping.set()
        self._state.request_stop()
        self._owner.post(lambda: None)

    def run(self, messages: Iterator[dict[str, Any]]) -> None:
        """Serve the front end until it ends or asks to stop; the mirror is flat then.

        Raises the exception of a device that did not close, or of a background thread.
        """
        silence = BackgroundThread(
            "front end silence", self._check_front_end, self._front_end_timeout_s / 5, self._on_thread_failure
        )
        self._state_publisher.start(self._on_thread_failure)
        BackgroundThread(
            "requests", lambda: self._request_handler.run(messages), on_failure=self._on_thread_failure
        ).start()
        silence.start()
        try:
            self._owner.open()
            while not self._stopping.is_set():
                self._owner.run_next_job()
        finally:
            silence.stop()
            try:
                self._owner.close()
            finally:
                self._recording.set_recording(on=False)
                self._state_publisher.stop()
                self._publisher.close()
        if self._failure is not None:
            raise self._failure

    def _check_front_end(self) -> None:
        """Make the mirror safe when the front end is silent."""
        silence_s, limit_s = self._channel.silence_s, self._front_end_timeout_s
        if silence_s > limit_s and self._state.snapshot.fault is None:
            self._owner.request_safe_state(
                f"the server's front end was silent for {silence_s:.0f} s (limit {limit_s:g} s)"
            )

    def _on_thread_failure(self, error: Exception) -> None:
        """End the engine without a clean exit: the front end reports a fault and can start another engine."""
        self._failure = error
        self.request_stop()

    def _send_state(self, state: State) -> None:
        self._channel.post({"state": state.model_dump(mode="json")})


def main() -> None:
    """Run an engine; ``argv`` holds the descriptors of the channel and of the fail-safe process's pipe."""
    # The front end handles Ctrl-C.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    descriptor, failsafe_pipe = (int(word) for word in sys.argv[1:3])
    channel = Channel(socket.socket(fileno=descriptor))
    messages = channel.messages()
    setup = EngineSetup.model_validate(next(messages))
    forward_log(lambda line: channel.post({"log": line.model_dump(mode="json")}))
    try:
        Engine(channel, setup).run(messages)
        # The mirror is flat: the fail-safe process has nothing to do.
        os.write(failsafe_pipe, CLEAN_EXIT)
        channel.post({"clean_exit": True})
    finally:
        channel.close()


if __name__ == "__main__":
    main()
