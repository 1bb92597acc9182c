"""Supervises the engine (start, limits, end), and holds the state that clients see."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import Any

from pydantic import ValidationError

from escape_hw.config.system import ServerSection
from escape_hw.errors import EscapeError
from escape_hw.io.provenance import format_utc
from escape_hw.remote.state import (
    DeviceHealth,
    FaultState,
    FrameCounters,
    Illumination,
    LatencyState,
    Phase,
    State,
)
from escape_hw.server.frontend.engine_process import STOP_TIMEOUT_S, EngineProcess
from escape_hw.server.frontend.lease import LeaseManager
from escape_hw.server.frontend.transport import ZmqTransport
from escape_hw.server.ipc.channel import EngineSetup
from escape_hw.server.ipc.log import ServerLog
from escape_hw.server.safety.journal import RESET, ServerJournal
from escape_hw.server.safety.watchdog import Watchdog

log = logging.getLogger(__name__)


class PublishedState:
    """Holds and publishes the state; its ``notes`` stay."""

    def __init__(
        self, state: State, leases: LeaseManager, transport: ZmqTransport, server_log: ServerLog
    ) -> None:
        self.state, self._leases, self._transport, self._log = state, leases, transport, server_log
        #: Number of the newest entry of the night log.
        self.last_night_entry = -1

    def update(self, state: State | None = None) -> None:
        """Publish a new state of the engine, or the present one with new front-end values."""
        before = self.state
        self.state = (before if state is None else state).model_copy(
            update={
                "serial": before.serial + 1, "server_pid": before.server_pid, "lease": self._leases.lease,
                "clients": self._leases.count, "refused_requests": self._transport.refused,
                "notes": before.notes, "unattended_for_s": self._leases.seconds_without_holder(),
                "unattended_limit_s": before.unattended_limit_s, "last_night_entry": self.last_night_entry,
                "last_log_line": self._log.last_number,
            }
        )  # fmt: skip
        self._transport.publish("state", self.state)


#: Seconds that an engine may be silent while its mirror is flat and nothing runs.
IDLE_SILENCE_LIMIT_S = 120.0
#: Seconds after which an engine is killed that has not made the mirror flat on request.
_SAFETY_TIMEOUT_S = 5.0
#: Seconds between two heartbeats to the engine.
_HEARTBEAT_S = 1.0


def silence_limit_s(state: State, engine_pid: int, limits: ServerSection) -> float:
    """Seconds that an engine may be silent when this is the last published state.

    An engine that hangs in a run is not idle: it may have moved the mirror since its last state. The state of
    an earlier engine says nothing about one that starts. Compilation on a busy computer may delay an idle
    engine, which is harmless.
    """
    starts = state.engine_pid != engine_pid
    idle = state.active_run is None and not state.loop.closed and state.mirror.peak == 0
    return IDLE_SILENCE_LIMIT_S if starts or idle else limits.engine_silence_s


_RESTART_REMEDY = f"Read the log, then clear the fault to start the engine again: {RESET}."


class EngineSupervisor:
    """Starts, monitors and ends the engine process.

    Messages that are no state go to ``on_message``. ``on_exit`` is called after the end of an engine: pending
    requests get no reply then. ``stopping`` becomes true when the server has to end.
    """

    def __init__(
        self,
        limits: ServerSection,
        setup: EngineSetup,
        journal: ServerJournal,
        published: PublishedState,
        on_message: Callable[[dict[str, Any]], object],
        on_exit: Callable[[], object],
    ) -> None:
        self._limits, self._setup, self._journal, self._published = limits, setup, journal, published
        self._on_message, self._on_exit = on_message, on_exit
        self._watchdog = Watchdog(limits)
        self._last_heartbeat_s, self._kill_reason, self.stopping = 0.0, "", False
        self._stop_requested_s: float | None = None
        self._engine: EngineProcess | None = None
        self.start()

    # ------------------------------------------------------------ life
    def start(self) -> None:
        """Start an engine, with the products of the one before."""
        self._setup = self._setup.model_copy(update={"products": self._published.state.products})
        self._engine = EngineProcess(self._setup, str(self._journal.folder))
        log.info("engine of %s: process %d", self._journal.system, self._engine.process.pid)

    @property
    def running_engine(self) -> EngineProcess | None:
        """The engine, ``None`` when there is none or it has died."""
        return self._engine if self._engine is not None and self._engine.process.running else None

    @property
    def has_ended(self) -> bool:
        """Whether there is no engine, and the fail-safe process of the last one has ended."""
        return self._engine is None

    def note_stop_request(self) -> bool:
        """Note that the engine is asked to end; false when it was before."""
        if self._stop_requested_s is not None:
            return False
        self._stop_requested_s = time.monotonic()
        return True

    def stop(self) -> None:
        """Ask the engine to end with a flat mirror; may be repeated."""
        if not self.note_stop_request():
            return
        log.info("stopping: mirror flat, devices closed")
        if self._engine is None:
            self.stopping = True
        else:
            self._engine.send({"stop": True})

    def close(self) -> bool:
        """End the engine and wait for it; false when it did not leave a flat mirror."""
        engine, self._engine = self._engine, None
        if engine is None:
            return True
        engine.close_channel()
        return engine.close()

    def make_safe(self, reason: str, remedy: str) -> None:
        """Ask the engine to latch a fault and make the mirror safe."""
        if self._engine is not None:
            self._engine.send({"make_safe": {"reason": reason, "remedy": remedy}})

    # ------------------------------------------------------------ messages
    def receive_messages(self, engine: EngineProcess) -> None:
        """Handle the messages that have arrived."""
        for message in engine.receive():
            try:
                self._handle_message(message)
            except (ValidationError, EscapeError) as error:
                # An invalid number or a full disk does not end the supervision.
                log.error("a message of the engine could not be handled: %s", error)

    def _handle_message(self, message: dict[str, Any]) -> None:
        if "state" in message:
            self._published.update(State.model_validate(message["state"]))
            violation = self._watchdog.check(self._published.state)
            if violation is not None:
                self.make_safe(violation.reason, violation.remedy)
            # Last: a full disk is an error.
            self._journal.write_products(self._published.state.products)
            return
        self._on_message(message)
        if "run" in message:
            self._journal.write(message["run"])
            self._setup = self._setup.model_copy(update={"first_run_id": self._journal.last_run_id + 1})
        elif "ended" in message:
            self._journal.write(None)

    # ------------------------------------------------------------ limits
    def check(self, oldest_safety_request_s: float) -> None:
        """Apply the limits; call this regularly.

        ``oldest_safety_request_s``: seconds that the oldest safety request has waited for its reply, or 0.
        """
        engine, now = self._engine, time.monotonic()
        if engine is None:
            return
        engine.flush()
        # Read before the engine's own state: the fail-safe process ends only after its engine.
        due, failsafe_is_running = now - self._last_heartbeat_s > _HEARTBEAT_S, engine.failsafe.running
        if due:
            self._last_heartbeat_s = now
            engine.send({"heartbeat": True})
        if not engine.process.running:
            self._on_engine_exit(engine)
            return
        if due:
            engine.maintain_failsafe(failsafe_is_running)
        state = self._published.state
        limit = silence_limit_s(state, engine.process.pid, self._limits)
        # The state may be the last one of an engine that died, whose mirror was made flat since.
        is_current = state.engine_pid == engine.process.pid
        silence = now - engine.last_message_s
        if silence > limit:
            self._kill(engine, f"the engine was silent for {silence:.1f} s (limit {limit:g} s)")
        elif self._stop_requested_s is not None and now - self._stop_requested_s > STOP_TIMEOUT_S:
            self._kill(engine, f"the engine did not end within {STOP_TIMEOUT_S:g} s")
        elif is_current and state.mirror.peak > 0 and oldest_safety_request_s > _SAFETY_TIMEOUT_S:
            self._kill(engine, f"the engine did not make the mirror flat within {_SAFETY_TIMEOUT_S:g} s")

    def _kill(self, engine: EngineProcess, reason: str) -> None:
        if not self._kill_reason:
            self._kill_reason = reason
            log.error("%s; it is killed, and the fail-safe process makes the mirror safe", reason)
            engine.process.kill()

    def _on_engine_exit(self, engine: EngineProcess) -> None:
        """Report the end of the engine; called again until the fail-safe process has ended, too."""
        self.receive_messages(engine)
        self._on_exit()
        if engine.ended_cleanly:
            engine.close()
            self._engine, self.stopping = None, True
            return
        why = self._kill_reason or f"the engine (process {engine.process.pid}) died"
        if engine.failsafe.running:
            if self._published.state.engine_pid:
                self._publish_fault(f"{why}; the fail-safe process makes the mirror safe")
            return
        engine.close()
        self._engine, self._kill_reason = None, ""
        report = self._journal.read_incident(engine.process.pid)
        no_report = "the fail-safe process left no report; check the mirror"
        self._publish_fault(f"{why}; {no_report if report is None else report.mirror}")
        self.stopping = self._stop_requested_s is not None

    def _publish_fault(self, reason: str) -> None:
        """Publish that there is no engine, and why."""
        log.error("FAULT: %s", reason)
        state = self._published.state
        lost = {"health": DeviceHealth.LOST, "facts": {}, "message": "the engine has ended"}
        devices = tuple(one.model_copy(update=lost) for one in state.devices)
        recording = state.recording
        if recording.recording:
            ended = {"recording": False, "fault": "the engine has ended; what was written before is kept"}
            recording = recording.model_copy(update=ended)
        self._published.update(
            state.model_copy(
                update={
                    "devices": devices, "rates": FrameCounters(), "illumination": Illumination(),
                    "latency": LatencyState(), "phase": Phase.FAULT, "active_run": None, "streams": (),
                    "engine_pid": 0,
                    "fault": FaultState(reason=reason, at_utc=format_utc(), remedy=_RESTART_REMEDY),
                    "loop": state.loop.model_copy(update={"closed": False}), "recording": recording,
                }
            )
        )  # fmt: skip
