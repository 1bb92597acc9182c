"""The front: the process that clients speak to. It keeps lease, log and watch, and does no numerics."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import zmq

from escape_hw.api.procedure import Stop
from escape_hw.config.models import SystemConfig
from escape_hw.errors import EscapeError, RequestRefused
from escape_hw.remote import requests as ask
from escape_hw.remote.source import STREAMS
from escape_hw.remote.state import SCHEMA, Phase, State
from escape_hw.server.door import Door, Letter
from escape_hw.server.keeper import SAFETY, Keeper, Pending
from escape_hw.server.lease import Client
from escape_hw.server.samples import Samples
from escape_hw.server.setup import Setup

log = logging.getLogger(__name__)

_POLL_MS = 50


class Front(Keeper):
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
        super().__init__(config, door, Setup(config_text=config.to_toml(), runs=runs, reads=reads))
        self._samples, self._next = Samples(), 0
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
                engine = self._engine if self._engine is not None and not self._engine.ended() else None
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
        self._asked = time.monotonic()
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
            if isinstance(request, SAFETY):
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
        except Exception as error:
            log.exception("unexpected, at '%s'", request.verb)
            self._door.fail(letter.route, error)

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
        if self._engine is None or self._engine.ended():
            self._without_engine(letter)
            return
        if isinstance(letter.request, ask.Shutdown):
            self._asked = time.monotonic()
        number = self._number()
        self._pending[number] = Pending(letter, time.monotonic())
        self._engine.send({"id": number, "request": _plain(letter.request)})

    def _without_engine(self, letter: Letter) -> None:
        """What can be done while there is no engine; the mirror is as the guardian left it."""
        if isinstance(letter.request, ask.Shutdown):
            self._ending = True
        elif self._engine is not None:
            raise RequestRefused("the engine has died, and its guardian makes the mirror safe; wait a moment")
        elif isinstance(letter.request, ask.ClearFault):
            self._state = self._state.model_copy(update={"fault": None, "phase": Phase.STARTING})
            self._engine = self._start_engine()
        elif not isinstance(letter.request, SAFETY):
            raise RequestRefused("the engine has died; clear the fault to start it again")
        self._door.answer(letter.route, None)

    def _number(self) -> int:
        self._next += 1
        return self._next


def _plain(request: ask.Request) -> dict[str, Any]:
    return request.model_dump(mode="json")
