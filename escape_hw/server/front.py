"""The front: the process that clients speak to. It keeps lease, log and watch, and does no numerics."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import zmq

from escape_hw.api.procedure import Stop
from escape_hw.config.models import SystemConfig
from escape_hw.errors import EscapeError, RequestRefused
from escape_hw.io.provenance import software_version, utc_text
from escape_hw.remote import requests as ask
from escape_hw.remote.source import STREAMS
from escape_hw.remote.state import SCHEMA, Ended, Fault, LogLine, Phase, State
from escape_hw.server.door import Door, Letter
from escape_hw.server.engine_process import EngineProcess
from escape_hw.server.journal import Journal
from escape_hw.server.lease import Client, LeaseBook
from escape_hw.server.log_book import LogBook
from escape_hw.server.samples import Samples
from escape_hw.server.setup import Setup
from escape_hw.server.watchdog import Watchdog

log = logging.getLogger(__name__)

_POLL_MS = 50
#: A safety request that the engine does not answer for so long, its mirror not flat, ends the engine.
_SAFETY_S = 5.0
#: A sign of life for the engine, so often.
_TICK_S = 1.0
_SAFETY = (ask.OpenLoop, ask.Flatten, ask.Abort)
_WAY_OUT = "look at the log, then clear the fault to start the engine again"


@dataclass(frozen=True, slots=True)
class Pending:
    """A request that the engine has to answer."""

    letter: Letter
    since: float


class Front:
    """Serves one system.

    Parameters
    ----------
    config
        The system.
    door
        The sockets, bound.
    runs
        Folder under which runs go.
    reads
        Further folders that products may be loaded from.
    """

    def __init__(self, config: SystemConfig, door: Door, runs: Path, reads: tuple[Path, ...] = ()) -> None:
        self._config, self._door = config, door
        self._journal = Journal(config.system.name)
        self._log = LogBook(self._journal.folder / f"{config.system.name}.log", self._tell_line)
        notes = self._journal.before()
        self._leases, self._watchdog = LeaseBook(config.server.lease_s), Watchdog(config.server)
        self._samples = Samples()
        self._setup = Setup(config_text=config.to_toml(), runs=runs, reads=reads)
        self._pending: dict[int, Pending] = {}
        self._next, self._ticked, self._ending, self._asked = 0, 0.0, False, False
        self._condemned = ""
        self._state = State(
            at_utc=utc_text(), server_pid=os.getpid(), version=software_version(),
            system=config.system.name, simulated=config.simulated, seed=config.system.seed, notes=notes,
        )  # fmt: skip
        self._journal.write(None)
        self._engine: EngineProcess | None = self._start_engine()
        self._answers: dict[type[ask.Request], Callable[[Any, Letter, Client], object]] = {
            ask.GetState: lambda request, letter, client: self._state,
            ask.GetLog: lambda request, letter, client: [
                line.model_dump(mode="json") for line in self._log.after(request.after, request.count)
            ],
            ask.Acquire: self._acquire,
            ask.Heartbeat: lambda request, letter, client: None,
            ask.Release: self._release,
        }

    # ------------------------------------------------------------ life
    def run(self, stop: Stop) -> None:
        """Serve until told to stop; the mirror ends flat."""
        poller = zmq.Poller()
        for socket in self._door.sockets:
            poller.register(socket, zmq.POLLIN)
        try:
            while not self._ending:
                engine = self._engine
                if engine is not None:
                    poller.register(engine.connection.fileno(), zmq.POLLIN)
                poller.poll(_POLL_MS)
                if engine is not None:
                    poller.unregister(engine.connection.fileno())
                    self._hear(engine)
                for letter in self._door.letters():
                    self._take(letter)
                self._look_after()
                if stop.is_set() and not self._asked:
                    self._shut_down()
        finally:
            self._close()

    def _shut_down(self) -> None:
        self._asked = True
        log.info("stopping: mirror flat, devices closed")
        if self._engine is None:
            self._ending = True
        else:
            self._engine.send({"end": True})

    def _close(self) -> None:
        engine, self._engine = self._engine, None
        clean = True
        if engine is not None:
            engine.hang_up()
            clean = engine.close()
        self._state = self._state.model_copy(
            update={"phase": Phase.STOPPED, "serial": self._state.serial + 1}
        )
        self._door.publish("state", self._state)
        if clean:
            self._journal.close()
        self._samples.close()
        self._log.close()

    def _start_engine(self) -> EngineProcess:
        engine = EngineProcess(self._setup, str(self._journal.folder))
        log.info("engine of %s: process %d", self._config.system.name, engine.pid)
        return engine

    def _look_after(self) -> None:
        """What has to be done now and then."""
        now, engine = time.monotonic(), self._engine
        self._leases.expire()
        if engine is None:
            return
        engine.flush()
        # Looked at before the engine is: a guardian ends in order only after its engine.
        tick, guarded = now - self._ticked > _TICK_S, engine.guarded()
        if tick:
            self._ticked = now
            engine.send({"alive": True})
        if engine.ended():
            self._bury(engine)
            return
        if tick and not guarded:
            engine.replace_guardian()
        self._mind_abandoned(engine)
        silent, limit = now - engine.heard, engine.patience(self._config.server.silent_s)
        waiting = [one for one in self._pending.values() if isinstance(one.letter.request, _SAFETY)]
        if silent > limit:
            self._condemn(engine, f"the engine was silent for {silent:.1f} s (limit {limit:g} s)")
        elif self._state.mirror.peak > 0 and any(now - one.since > _SAFETY_S for one in waiting):
            self._condemn(engine, f"the engine did not make the mirror flat within {_SAFETY_S:g} s")

    def _mind_abandoned(self, engine: EngineProcess) -> None:
        lost, limit = self._leases.lost_for(), self._config.server.abandoned_s
        running = self._state.procedure
        if (
            running is None
            or lost <= limit
            or self._state.fault is not None
            or self._leases.lease is not None
        ):
            return
        self._leases.lost_at = None
        left = f"was left alone for {lost:.1f} s (limit {limit:g} s)"
        self._make_safe(
            engine, f"'{running.name}' (run {running.id}) {left}",
            "what it measured is kept; clear the fault, and resume the run if it is to go on",
        )  # fmt: skip

    def _make_safe(self, engine: EngineProcess, reason: str, way_out: str) -> None:
        engine.send({"fault": reason, "way_out": way_out})

    def _condemn(self, engine: EngineProcess, reason: str) -> None:
        if not self._condemned:
            self._condemned = reason
            log.error("%s; it is ended, and the guardian makes the mirror safe", reason)
            engine.kill()

    def _bury(self, engine: EngineProcess) -> None:
        """The engine has ended: in order, or the guardian has something to tell."""
        self._engine = None
        clean = engine.close()
        for pending in self._pending.values():
            self._door.fail(pending.letter.route, RequestRefused("the engine has ended"))
        self._pending.clear()
        if clean:
            self._ending = True
            return
        incident = self._journal.incident(engine.pid)
        done = "its guardian left no word; look at the mirror" if incident is None else incident.mirror
        reason = f"{self._condemned or f'the engine (process {engine.pid}) died'}; {done}"
        self._condemned = ""
        log.error("FAULT: %s", reason)
        fault = self._state.fault or Fault(reason=reason, at_utc=utc_text(), way_out=_WAY_OUT)
        self._became(
            self._state.model_copy(
                update={
                    "phase": Phase.FAULT, "fault": fault, "procedure": None, "streams": (), "engine_pid": 0,
                    "loop": self._state.loop.model_copy(update={"closed": False}),
                }
            )
        )  # fmt: skip
        self._ending = self._asked

    # ------------------------------------------------------------ the engine speaks
    def _hear(self, engine: EngineProcess) -> None:
        for message in engine.receive():
            if "state" in message:
                self._became(State.model_validate(message["state"]))
                verdict = self._watchdog.judge(self._state)
                if verdict is not None:
                    self._make_safe(engine, verdict.reason, verdict.way_out)
            elif "reply" in message:
                self._pass_on(message)
            elif "log" in message:
                self._log.add(LogLine.model_validate(message["log"]))
            elif "progress" in message:
                self._door.publish("progress", message["progress"])
            elif "run" in message:
                self._journal.write(message["run"])
                self._setup = self._setup.model_copy(update={"first_run": message["run"]["id"] + 1})
            elif "ended" in message:
                ended = Ended.model_validate(message["ended"])
                self._journal.write(None)
                self._door.publish("ended", ended)

    def _became(self, state: State) -> None:
        """Take the engine's state, add what the front knows, and tell everybody."""
        self._state = state.model_copy(
            update={
                "serial": self._state.serial + 1, "server_pid": os.getpid(), "lease": self._leases.lease,
                "clients": self._leases.count, "refused": self._door.refused, "notes": self._state.notes,
            }
        )  # fmt: skip
        self._door.publish("state", self._state)

    def _pass_on(self, message: dict[str, Any]) -> None:
        pending = self._pending.pop(message["reply"], None)
        if pending is None:
            return
        route = pending.letter.route
        if "error" in message:
            self._door.fail(route, message["error"])
        else:
            self._door.answer(route, message["answer"])

    def _tell_line(self, line: LogLine) -> None:
        self._door.publish("log", line)

    # ------------------------------------------------------------ clients speak
    def _take(self, letter: Letter) -> None:
        request = letter.request
        try:
            if isinstance(request, ask.Hello):
                self._door.answer(letter.route, self._greet(request, letter.route.sender))
                return
            client = self._leases.hear(request.client, letter.route.sender)
            if isinstance(request, ask.WRITING):
                self._leases.require(client)
            if isinstance(request, _SAFETY):
                log.warning("%s: %s", client.words, request.verb.replace("_", " "))
            if isinstance(request, ask.GetLatest):
                self._send_latest(request, letter)
            elif type(request) in self._answers:
                answer = self._answers[type(request)](request, letter, client)
                self._door.answer(letter.route, answer)
            else:
                self._forward(letter)
        except EscapeError as error:
            self._door.refuse(letter.route, error)

    def _greet(self, hello: ask.Hello, route: bytes) -> State:
        if hello.schema_version != SCHEMA:
            raise RequestRefused(
                f"this server speaks version {SCHEMA}, the client {hello.schema_version}; "
                "use the same version of escape-hw on both sides"
            )
        self._leases.greet(hello, route)
        return self._state

    def _acquire(self, request: ask.Acquire, letter: Letter, client: Client) -> object:
        lease = self._leases.acquire(client, request.take_over)
        self._became(self._state)
        return lease

    def _release(self, request: ask.Release, letter: Letter, client: Client) -> None:
        self._leases.release(client)
        self._became(self._state)

    def _send_latest(self, request: ask.GetLatest, letter: Letter) -> None:
        if request.stream not in STREAMS:
            raise RequestRefused(f"no stream is called '{request.stream}'; there are {', '.join(STREAMS)}")
        segment = {one.name: one.segment for one in self._state.streams}.get(request.stream)
        head, data = self._samples.newest(request.stream, segment, request.after)
        self._door.answer(letter.route, head, data)

    def _forward(self, letter: Letter) -> None:
        """Hand a request to the engine."""
        if self._engine is None:
            self._without_engine(letter)
            return
        if isinstance(letter.request, ask.Shutdown):
            self._asked = True
        number = self._number()
        self._pending[number] = Pending(letter, time.monotonic())
        self._engine.send({"id": number, "request": _plain(letter.request)})

    def _without_engine(self, letter: Letter) -> None:
        """What can be done while there is no engine; the mirror is as the guardian left it."""
        if isinstance(letter.request, ask.Shutdown):
            self._ending = True
        elif isinstance(letter.request, ask.ClearFault):
            self._state = self._state.model_copy(update={"fault": None, "phase": Phase.STARTING})
            self._engine = self._start_engine()
        elif not isinstance(letter.request, _SAFETY):
            raise RequestRefused("the engine has died; clear the fault to start it again")
        self._door.answer(letter.route, None)

    def _number(self) -> int:
        self._next += 1
        return self._next


def _plain(request: ask.Request) -> dict[str, Any]:
    return request.model_dump(mode="json")
