"""The front's side towards the engine: started, listened to, watched, and buried when it dies."""

from __future__ import annotations

import logging
import os
import time
from dataclasses import dataclass
from typing import Any

from pydantic import ValidationError

from escape_hw.config.models import SystemConfig
from escape_hw.errors import EscapeError, RequestRefused
from escape_hw.io.provenance import software_version, utc_text
from escape_hw.remote import requests as ask
from escape_hw.remote.state import Ended, Fault, LogLine, Phase, State
from escape_hw.server.door import Door, Letter
from escape_hw.server.engine_process import ENDING_S, PATIENCE_S, EngineProcess
from escape_hw.server.journal import Journal
from escape_hw.server.lease import LeaseBook
from escape_hw.server.log_book import LogBook
from escape_hw.server.setup import Setup
from escape_hw.server.watchdog import Watchdog

log = logging.getLogger(__name__)

#: Requests that everybody may make at any time.
SAFETY = (ask.OpenLoop, ask.Flatten, ask.Abort)
#: A safety request that the engine does not answer for so long, its mirror not flat, ends the engine.
_SAFETY_S = 5.0
#: A sign of life for the engine, so often.
_TICK_S = 1.0
_WAY_OUT = "look at the log, then clear the fault to start the engine again"


@dataclass(frozen=True, slots=True)
class Pending:
    """A request that the engine has to answer."""

    letter: Letter
    since: float


class Keeper:
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

    def __init__(self, config: SystemConfig, door: Door, setup: Setup) -> None:
        self._config, self._door, self._setup = config, door, setup
        self._journal = Journal(config.system.name)
        self._log = LogBook(self._journal.folder / f"{config.system.name}.log", self._tell_line)
        notes = self._journal.before()
        self._leases, self._watchdog = LeaseBook(config.server.lease_s), Watchdog(config.server)
        self._pending: dict[int, Pending] = {}
        self._ticked, self._ending, self._condemned = 0.0, False, ""
        #: When the server was asked to end, monotonic seconds; 0: it was not.
        self._asked = 0.0
        self._state = State(
            at_utc=utc_text(), server_pid=os.getpid(), version=software_version(),
            system=config.system.name, simulated=config.simulated, seed=config.system.seed, notes=notes,
        )  # fmt: skip
        self._journal.write(None)
        self._engine: EngineProcess | None = self._start_engine()

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
        if tick:
            engine.mind_guardian(guarded)
        self._mind_abandoned(engine)
        # On a busy machine a compiler may hold an engine up; that harms nobody while the mirror is flat.
        moving = self._state.mirror.peak > 0 or self._state.loop.closed
        silent, limit = now - engine.heard, self._config.server.silent_s if moving else PATIENCE_S
        waiting = [one for one in self._pending.values() if isinstance(one.letter.request, SAFETY)]
        if silent > limit:
            self._condemn(engine, f"the engine was silent for {silent:.1f} s (limit {limit:g} s)")
        elif self._asked and now - self._asked > ENDING_S:
            self._condemn(engine, f"the engine did not end within {ENDING_S:g} s")
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
        """The engine has ended: in order, or its guardian is at work, which nobody waits for here."""
        self._hear(engine)
        for pending in self._pending.values():
            self._door.fail(pending.letter.route, RequestRefused("the engine has ended"))
        self._pending.clear()
        if engine.said_goodbye:
            engine.close()
            self._engine, self._ending = None, True
            return
        why = self._condemned or f"the engine (process {engine.pid}) died"
        if engine.guarded():
            if self._state.engine_pid:
                self._lost(f"{why}; its guardian makes the mirror safe")
            return
        engine.close()
        self._engine, self._condemned = None, ""
        incident = self._journal.incident(engine.pid)
        done = "its guardian left no word; look at the mirror" if incident is None else incident.mirror
        self._lost(f"{why}; {done}")
        self._ending = bool(self._asked)

    def _lost(self, reason: str) -> None:
        """Tell everybody that there is no engine, and why."""
        log.error("FAULT: %s", reason)
        fault = Fault(reason=reason, at_utc=utc_text(), way_out=_WAY_OUT)
        self._became(
            self._state.model_copy(
                update={
                    "phase": Phase.FAULT, "fault": fault, "procedure": None, "streams": (), "engine_pid": 0,
                    "loop": self._state.loop.model_copy(update={"closed": False}),
                }
            )
        )  # fmt: skip

    def _hear(self, engine: EngineProcess) -> None:
        for message in engine.receive():
            try:
                self._understand(engine, message)
            except (ValidationError, EscapeError) as error:
                # A number that makes no sense, or a full disk, is no reason to let go of the engine.
                log.error("what the engine said could not be dealt with: %s", error)

    def _understand(self, engine: EngineProcess, message: dict[str, Any]) -> None:
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
            self._setup = self._setup.model_copy(update={"first_run": message["run"]["id"] + 1})
            self._journal.write(message["run"])
        elif "ended" in message:
            self._door.publish("ended", Ended.model_validate(message["ended"]))
            self._journal.write(None)

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
