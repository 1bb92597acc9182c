"""Starts, monitors and ends the engine process and its fail-safe process; forwards the engine's messages."""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from pydantic import ValidationError

from escape_hw.config.system import SystemConfig
from escape_hw.errors import EscapeError, RequestRefused
from escape_hw.io.provenance import format_utc, get_software_version
from escape_hw.remote import requests
from escape_hw.remote.state import FaultState, FinishedRun, LogLine, Phase, State
from escape_hw.server.frontend.lease import LeaseManager
from escape_hw.server.frontend.transport import IncomingRequest, ZmqTransport
from escape_hw.server.ipc.channel import EngineSetup, MessageDecoder, encode
from escape_hw.server.ipc.log import ServerLog
from escape_hw.server.safety.failsafe import FailsafeSettings
from escape_hw.server.safety.journal import ServerJournal
from escape_hw.server.safety.watchdog import Watchdog
from escape_hw.streams.segments import process_start

#: Seconds between the first start and the next; they double with every start ...
INITIAL_S = 1.0
#: ... up to so many.
MAX_S = 60.0
#: What has lived for so long did not die of its start.
RESET_AFTER_S = 60.0


class Backoff:
    """Between starts of something that ought to live: 1, 2, 4 ... 60 s, and 1 s again once it has lived.

    Parameters
    ----------
    clock
        Monotonic seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._started, self._delay_s = clock(), INITIAL_S

    def mark_alive(self) -> None:
        """It lives; to be told now and then."""
        if self._clock() - self._started >= RESET_AFTER_S:
            self._delay_s = INITIAL_S

    def is_over(self) -> bool:
        """Whether it may be started again."""
        return self._clock() - self._started >= self._delay_s

    def start(self) -> float:
        """It is started again now; seconds that it has to wait for the next time if it dies at once."""
        self._started, self._delay_s = self._clock(), min(2 * self._delay_s, MAX_S)
        return self._delay_s


log = logging.getLogger(__name__)

#: Seconds that an engine has to end in order: a partial result is saved meanwhile.
STOP_TIMEOUT_S = 60.0
#: Seconds that an engine may be silent while its mirror is flat.
IDLE_SILENCE_LIMIT_S = 120.0
_ENGINE, _FAILSAFE = "escape_hw.server.engine.main", "escape_hw.server.safety.failsafe"


class EngineProcess:
    """A running engine with its guardian.

    Parameters
    ----------
    setup
        The engine's orders.
    incidents
        Folder in which the guardian writes what it did.

    Attributes
    ----------
    connection
        The front's end of the channel, for a poller.
    said_goodbye
        Whether the engine ended in order.
    heard
        When it last said something, monotonic seconds; when it was started, before its first word.
    """

    def __init__(self, setup: EngineSetup, incidents: str) -> None:
        self.connection, engine_end = socket.socketpair()
        self._pipe_end, held_end = os.pipe()
        try:
            self._process = self._spawn(_ENGINE, (engine_end.fileno(), held_end))
            started = process_start(self._process.pid) or 0
            self._failsafe_settings = FailsafeSettings(
                config_text=setup.config_text, incidents=incidents, pid=self._process.pid, started=started
            )
            self._failsafe, self._backoff = self._start_failsafe(), Backoff()
        finally:
            engine_end.close()
            os.close(held_end)
        self._lines = MessageDecoder()
        self._unsent = b""
        self.ended_cleanly = False
        self.last_message_s = time.monotonic()
        self.send(setup.model_dump(mode="json"))
        self.connection.setblocking(False)

    @staticmethod
    def _spawn(module: str, descriptors: tuple[int, ...], **options: Any) -> subprocess.Popen[bytes]:
        # A session of its own: neither the terminal's Ctrl-C nor its end reaches it.
        return subprocess.Popen(
            [sys.executable, "-m", module, *map(str, descriptors)],
            pass_fds=descriptors, start_new_session=True, **options,
        )  # fmt: skip

    def _start_failsafe(self) -> subprocess.Popen[bytes]:
        failsafe = self._spawn(_FAILSAFE, (self._pipe_end,), stdin=subprocess.PIPE)
        if failsafe.stdin is None:
            raise RuntimeError("the guardian has no standard input")
        failsafe.stdin.write(self._failsafe_settings.model_dump_json().encode())
        failsafe.stdin.close()
        return failsafe

    def maintain_failsafe(self, alive: bool) -> None:
        """Have another guardian at the same pipe where the one before was killed and the engine goes on.

        To be called every second. One that dies at once, or cannot be started, is tried again after a
        pause that grows.

        Parameters
        ----------
        alive
            Whether there was a guardian, when the engine was last seen alive.
        """
        if alive:
            self._backoff.mark_alive()
            return
        if not self._backoff.is_over():
            return
        pause = self._backoff.start()
        log.error(
            "the guardian (process %d) died; another one takes its place, and the next not within %g s",
            self._failsafe.pid, pause,
        )  # fmt: skip
        try:
            self._failsafe = self._start_failsafe()
        except OSError as error:
            # Whatever killed the guardian, such as want of memory, must not end the server, too.
            log.error("no guardian could be started, which is tried again in %g s: %s", pause, error)

    @property
    def pid(self) -> int:
        """The engine's process."""
        return self._process.pid

    def send(self, message: Mapping[str, Any]) -> None:
        """Send a message without waiting: what the engine does not take now goes with the next one."""
        self._unsent += encode(message)
        self.flush()

    def flush(self) -> None:
        """Send what could not be sent before."""
        with contextlib.suppress(BlockingIOError, BrokenPipeError, ConnectionResetError):
            while self._unsent:
                self._unsent = self._unsent[self.connection.send(self._unsent) :]

    def receive(self) -> Iterator[dict[str, Any]]:
        """What has arrived."""
        while True:
            try:
                data = self.connection.recv(1 << 18)
            except (BlockingIOError, ConnectionResetError):
                return
            if not data:
                return
            self.last_message_s = time.monotonic()
            for message in self._lines.feed(data):
                self.ended_cleanly = self.ended_cleanly or "goodbye" in message
                yield message

    def has_exited(self) -> bool:
        """Whether the engine's process is gone."""
        return self._process.poll() is not None

    def failsafe_is_running(self) -> bool:
        """Whether the guardian is still there."""
        return self._failsafe.poll() is None

    def close_channel(self) -> None:
        """Say no more; an engine that notices it stops, the mirror flat."""
        with contextlib.suppress(OSError):
            self.connection.shutdown(socket.SHUT_WR)

    def kill(self) -> None:
        """End an engine that does not answer any more; the guardian does the rest."""
        with contextlib.suppress(ProcessLookupError):
            os.kill(self._process.pid, signal.SIGCONT)
        self._process.kill()

    def close(self) -> bool:
        """Wait for both to end; true when the engine ended in order."""
        try:
            self._process.wait(STOP_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            log.error("the engine did not end within %g s; it is killed", STOP_TIMEOUT_S)
            self.kill()
            self._process.wait()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._failsafe.wait(STOP_TIMEOUT_S)
        os.close(self._pipe_end)
        list(self.receive())
        self.connection.close()
        return self.ended_cleanly


#: Requests that everybody may make at any time.
SAFETY_REQUESTS = (requests.OpenLoop, requests.Flatten, requests.AbortProcedure)
#: A safety request that the engine does not answer for so long, its mirror not flat, ends the engine.
_SAFETY_TIMEOUT_S = 5.0
#: A sign of life for the engine, so often.
_ALIVE_PERIOD_S = 1.0
_WAY_OUT = "look at the log, then clear the fault to start the engine again"


@dataclass(frozen=True, slots=True)
class PendingRequest:
    """A request that the engine has to answer."""

    incoming: IncomingRequest
    since: float


class EngineSupervisor:
    """Keeps an engine; the part of a front that speaks to it.

    Parameters
    ----------
    config
        The system.
    door
        The sockets, bound.
    setup
        The engine's orders.
    """

    def __init__(self, config: SystemConfig, transport: ZmqTransport, setup: EngineSetup) -> None:
        self._config, self._transport, self._setup = config, transport, setup
        self._journal = ServerJournal(config.system.name)
        self._log = ServerLog(self._journal.folder / f"{config.system.name}.log", self._publish_log_line)
        notes = self._journal.previous_end()
        self._leases, self._watchdog = LeaseManager(config.server.lease_s), Watchdog(config.server)
        self._pending: dict[int, PendingRequest] = {}
        self._last_tick_s, self._stopping, self._kill_reason = 0.0, False, ""
        #: When the server was asked to end, monotonic seconds; 0: it was not.
        self._stop_requested_s = 0.0
        self._state = State(
            at_utc=format_utc(), server_pid=os.getpid(), version=get_software_version(),
            system=config.system.name, simulated=config.simulated, seed=config.system.seed, notes=notes,
        )  # fmt: skip
        self._journal.write(None)
        self._engine: EngineProcess | None = self._start_engine()

    def _start_engine(self) -> EngineProcess:
        engine = EngineProcess(self._setup, str(self._journal.folder))
        log.info("engine of %s: process %d", self._config.system.name, engine.pid)
        return engine

    def _check_engine(self) -> None:
        """What has to be done now and then."""
        now, engine = time.monotonic(), self._engine
        self._leases.expire()
        if engine is None:
            return
        engine.flush()
        # Looked at before the engine is: a guardian ends in order only after its engine.
        tick, failsafe_is_running = now - self._last_tick_s > _ALIVE_PERIOD_S, engine.failsafe_is_running()
        if tick:
            self._last_tick_s = now
            engine.send({"alive": True})
        if engine.has_exited():
            self._on_engine_exit(engine)
            return
        if tick:
            engine.maintain_failsafe(failsafe_is_running)
        self._check_abandoned_run(engine)
        # On a busy machine a compiler may hold an engine up; that harms nobody while the mirror is flat.
        moving = self._state.mirror.peak > 0 or self._state.loop.closed
        silent, limit = (
            now - engine.last_message_s,
            self._config.server.engine_silence_s if moving else IDLE_SILENCE_LIMIT_S,
        )
        waiting = [one for one in self._pending.values() if isinstance(one.incoming.request, SAFETY_REQUESTS)]
        if silent > limit:
            self._kill_engine(engine, f"the engine was silent for {silent:.1f} s (limit {limit:g} s)")
        elif self._stop_requested_s and now - self._stop_requested_s > STOP_TIMEOUT_S:
            self._kill_engine(engine, f"the engine did not end within {STOP_TIMEOUT_S:g} s")
        elif self._state.mirror.peak > 0 and any(now - one.since > _SAFETY_TIMEOUT_S for one in waiting):
            self._kill_engine(
                engine, f"the engine did not make the mirror flat within {_SAFETY_TIMEOUT_S:g} s"
            )

    def _check_abandoned_run(self, engine: EngineProcess) -> None:
        lost, limit = self._leases.seconds_without_holder(), self._config.server.unattended_s
        running = self._state.procedure
        if (
            running is None
            or lost <= limit
            or self._state.fault is not None
            or self._leases.lease is not None
        ):
            return
        self._leases.released_s = None
        abandonment = f"was left alone for {lost:.1f} s (limit {limit:g} s)"
        self._make_safe(
            engine, f"'{running.name}' (run {running.id}) {abandonment}",
            "what it measured is kept; clear the fault, and resume the run if it is to go on",
        )  # fmt: skip

    def _make_safe(self, engine: EngineProcess, reason: str, way_out: str) -> None:
        engine.send({"fault": reason, "way_out": way_out})

    def _kill_engine(self, engine: EngineProcess, reason: str) -> None:
        if not self._kill_reason:
            self._kill_reason = reason
            log.error("%s; it is ended, and the guardian makes the mirror safe", reason)
            engine.kill()

    def _on_engine_exit(self, engine: EngineProcess) -> None:
        """The engine has ended: in order, or its guardian is at work, which nobody waits for here."""
        self._receive_messages(engine)
        for pending in self._pending.values():
            self._transport.send_error(pending.incoming.route, RequestRefused("the engine has ended"))
        self._pending.clear()
        if engine.ended_cleanly:
            engine.close()
            self._engine, self._stopping = None, True
            return
        why = self._kill_reason or f"the engine (process {engine.pid}) died"
        if engine.failsafe_is_running():
            if self._state.engine_pid:
                self._publish_engine_fault(f"{why}; its guardian makes the mirror safe")
            return
        engine.close()
        self._engine, self._kill_reason = None, ""
        incident = self._journal.incident(engine.pid)
        outcome = "its guardian left no word; look at the mirror" if incident is None else incident.mirror
        self._publish_engine_fault(f"{why}; {outcome}")
        self._stopping = bool(self._stop_requested_s)

    def _publish_engine_fault(self, reason: str) -> None:
        """Tell everybody that there is no engine, and why."""
        log.error("FAULT: %s", reason)
        fault = FaultState(reason=reason, at_utc=format_utc(), way_out=_WAY_OUT)
        self._set_state(
            self._state.model_copy(
                update={
                    "phase": Phase.FAULT, "fault": fault, "procedure": None, "streams": (), "engine_pid": 0,
                    "loop": self._state.loop.model_copy(update={"closed": False}),
                }
            )
        )  # fmt: skip

    def _receive_messages(self, engine: EngineProcess) -> None:
        for message in engine.receive():
            try:
                self._handle_message(engine, message)
            except (ValidationError, EscapeError) as error:
                # A number that makes no sense, or a full disk, is no reason to let go of the engine.
                log.error("what the engine said could not be dealt with: %s", error)

    def _handle_message(self, engine: EngineProcess, message: dict[str, Any]) -> None:
        if "state" in message:
            self._set_state(State.model_validate(message["state"]))
            violation = self._watchdog.check(self._state)
            if violation is not None:
                self._make_safe(engine, violation.reason, violation.way_out)
        elif "reply" in message:
            self._forward_reply(message)
        elif "log" in message:
            self._log.add(LogLine.model_validate(message["log"]))
        elif "progress" in message:
            self._transport.publish("progress", message["progress"])
        elif "run" in message:
            self._setup = self._setup.model_copy(update={"first_run": message["run"]["id"] + 1})
            self._journal.write(message["run"])
        elif "ended" in message:
            self._transport.publish("ended", FinishedRun.model_validate(message["ended"]))
            self._journal.write(None)

    def _set_state(self, state: State) -> None:
        """Take the engine's state, add what the front knows, and tell everybody."""
        self._state = state.model_copy(
            update={
                "serial": self._state.serial + 1, "server_pid": os.getpid(), "lease": self._leases.lease,
                "clients": self._leases.count, "refused": self._transport.refused, "notes": self._state.notes,
            }
        )  # fmt: skip
        self._transport.publish("state", self._state)

    def _forward_reply(self, message: dict[str, Any]) -> None:
        pending = self._pending.pop(message["reply"], None)
        if pending is None:
            return
        route = pending.incoming.route
        if "error" in message:
            self._transport.send_error(route, message["error"])
        else:
            self._transport.answer(route, message["answer"])

    def _publish_log_line(self, line: LogLine) -> None:
        self._transport.publish("log", line)
