"""A client that looks: state, streams, log; what can be started, and what it would do."""

from __future__ import annotations

import os
import re
import socket
import sys
import threading
import time
import uuid
from collections import deque
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import Any, Self

import numpy as np

from escape_hw.errors import ClientUnknown, EscapeError, ServerGone
from escape_hw.remote import requests as ask
from escape_hw.remote.address import Endpoint
from escape_hw.remote.link import Link
from escape_hw.remote.source import Sample
from escape_hw.remote.state import (
    SCHEMA,
    Arguments,
    Ended,
    Geometry,
    LogLine,
    Phase,
    Plan,
    ProcedureEntry,
    Running,
    State,
)
from escape_hw.streams.reader_shelf import ReaderShelf

#: Longest wait for an ordinary answer, and for one that comes when a mirror is flat, seconds.
TIMEOUT_S, SLOW_S = 3.0, 30.0
#: A server that tells its state five times a second and was not heard of for so long is gone.
_STALE_S = 2.0
_LINES = 5000
#: Longest wait for the event that belongs to an answer, seconds.
_EVENT_S = 10.0


class Viewer:
    """Looks at a server; satisfies :class:`~escape_hw.remote.source.Source`.

    Parameters
    ----------
    endpoint
        Where the server listens.
    name
        Who this is, for the other clients.
    keys
        Keys for a server on another machine.

    Attributes
    ----------
    client
        This client's number, as in ``state.lease.client``.

    Raises
    ------
    ServerGone
        Nobody answers.
    RequestRefused
        The server is of another version.
    """

    def __init__(
        self, endpoint: Endpoint, name: str = "", keys: tuple[bytes, bytes, bytes] | None = None
    ) -> None:
        self.client = str(uuid.uuid4())
        self._name = name or _program()
        self._closed = self._known = False
        self._changed = threading.Condition()
        self._state = State()
        self._log: deque[LogLine] = deque(maxlen=_LINES)
        self._ended: dict[int, Ended] = {}
        self._geometry: tuple[object, Geometry] | None = None
        self._procedures: tuple[ProcedureEntry, ...] | None = None
        self._readers = ReaderShelf()
        self._here = endpoint.requests.startswith("ipc://")
        self._link = Link(endpoint, self._event, self._beat, keys=keys)
        try:
            self._hello()
        except EscapeError:
            self.close()
            raise

    def _hello(self) -> None:
        answer, _, _ = self._link.ask(self._greeting(), TIMEOUT_S)
        self._known = True
        with self._changed:
            self._state = State.model_validate(answer)
        lines, _ = self._ask(ask.GetLog(client=self.client, count=1000))
        with self._changed:
            known = {line.number for line in self._log}
            old = [LogLine.model_validate(line) for line in lines if line["number"] not in known]
            self._log = deque(sorted((*old, *self._log), key=lambda line: line.number), maxlen=_LINES)

    def _greeting(self) -> Mapping[str, Any]:
        name, host = (re.sub(r"[^\w .+@:-]", "-", text)[:80] for text in (self._name, socket.gethostname()))
        hello = ask.Hello(client=self.client, schema_version=SCHEMA, name=name, host=host, pid=os.getpid())
        return hello.model_dump(mode="json")

    # ------------------------------------------------------------ life
    def close(self) -> None:
        """Hang up; the server goes on."""
        if self._closed:
            return
        self._closed = True
        self._link.close()
        self._readers.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __repr__(self) -> str:
        state = self.state
        return f"<Connection to {state.system}, {state.phase.value}, {'alive' if self.connected else 'gone'}>"

    def _repr_html_(self) -> str:
        from escape_hw.remote.html import state_html

        return state_html(self.state)

    def _beat(self, refused: bool) -> Mapping[str, Any] | None:
        if not self._known:
            return None
        # Who was halted for long has been forgotten.
        return self._greeting() if refused else {"verb": "heartbeat", "client": self.client}

    def _ask(self, request: ask.Request, timeout_s: float = TIMEOUT_S) -> tuple[Any, bytes]:
        document = request.model_dump(mode="json")
        try:
            answer, data, serial = self._link.ask(document, timeout_s)
        except ClientUnknown:
            self._hello()
            answer, data, serial = self._link.ask(document, timeout_s)
        if isinstance(request, ask.CHANGING):
            # Events come another way than answers: who looks at the state next finds what was done.
            with self._changed:
                self._changed.wait_for(lambda: self._state.serial >= serial, _EVENT_S)
        return answer, data

    def _event(self, topic: str, document: dict[str, Any]) -> None:
        with self._changed:
            if topic == "state":
                self._state = State.model_validate(document)
            elif topic == "log":
                line = LogLine.model_validate(document)
                if not self._log or line.number > self._log[-1].number:
                    self._log.append(line)
            elif topic == "progress":
                running = Running.model_validate(document)
                self._state = self._state.model_copy(update={"procedure": running})
            elif topic == "ended":
                ended = Ended.model_validate(document)
                self._ended[ended.id] = ended
            self._changed.notify_all()

    # ------------------------------------------------------------ to look
    @property
    def connected(self) -> bool:
        """Whether the server was heard of lately."""
        return not self._closed and time.monotonic() - self._link.heard < _STALE_S

    @property
    def state(self) -> State:
        """The newest state."""
        return self._state

    @property
    def holds_lease(self) -> bool:
        """Whether this client may write, as far as it knows."""
        lease = self._state.lease
        return lease is not None and lease.client == self.client

    def latest(self, stream: str, after: int = -1) -> Sample | None:
        """The newest entry of a stream, or ``None`` when there is none newer than ``after``."""
        if not self._here:
            return self._latest_from_afar(stream, after)
        segment = next((one.segment for one in self._state.streams if one.name == stream), None)
        reader = self._readers.reader(stream, segment)
        return None if reader is None else reader.latest(after)

    def _latest_from_afar(self, stream: str, after: int) -> Sample | None:
        try:
            head, data = self._ask(ask.made(ask.GetLatest, client=self.client, stream=stream, after=after))
        except ServerGone:
            return None
        if head is None:
            return None
        array = np.frombuffer(data, np.dtype(head["dtype"])).reshape(head["shape"])
        return Sample(head["index"], head["exposed_ns"], head["arrived_ns"], array, head["meta"])

    def geometry(self) -> Geometry:
        """Where slopes and actuators stand; asked for again when the state says that it changed."""
        state = self._state
        key = (state.engine_pid, state.phase is Phase.STARTING, state.geometries)
        known = self._geometry
        if known is None or known[0] != key:
            try:
                answer, _ = self._ask(ask.GetGeometry(client=self.client))
            except EscapeError:
                return Geometry() if known is None else known[1]
            known = self._geometry = (key, Geometry.model_validate(answer))
        return known[1]

    def log_after(self, number: int) -> Sequence[LogLine]:
        """Log lines after a number."""
        with self._changed:
            return [line for line in self._log if line.number > number]

    def procedures(self) -> Sequence[ProcedureEntry]:
        """What can be started."""
        if self._procedures is None:
            answer, _ = self._ask(ask.GetProcedures(client=self.client), SLOW_S)
            self._procedures = tuple(ProcedureEntry.model_validate(entry) for entry in answer)
        return self._procedures

    def check(self, procedure: str, arguments: Arguments | None = None) -> Plan:
        """What a procedure would do; nothing moves.

        Raises
        ------
        ConfigError
            An argument is wrong; says which and the way out.
        """
        request = ask.made(ask.Check, client=self.client, procedure=procedure, arguments=arguments or {})
        answer, _ = self._ask(request, SLOW_S)
        return Plan.model_validate(answer)

    def wait_for(self, run: int, timeout_s: float) -> Ended | None:
        """How a run ended, or ``None`` when it goes on; waits for news at most so long."""
        with self._changed:
            found = self._how_ended(run)
            if found is None:
                self._changed.wait(timeout_s)
                found = self._how_ended(run)
            return found

    def _how_ended(self, run: int) -> Ended | None:
        last = self._state.last
        return last if last is not None and last.id == run else self._ended.get(run)


def _program() -> str:
    """What other clients call this one: its script, or that it is a notebook."""
    name = os.path.basename(sys.argv[0])
    return "notebook" if name.startswith("ipykernel") else name or "python"
