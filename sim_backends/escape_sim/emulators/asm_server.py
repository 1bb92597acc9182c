"""Connections to the emulated adaptive secondary: one owner, many observers."""

from __future__ import annotations

import asyncio
import time

from escape_hw.api.adaptive_secondary import ShellState
from escape_sim.emulators import asm_wire as w
from escape_sim.emulators.asm_answers import Answers
from escape_sim.emulators.asm_body import AsmBody
from escape_sim.emulators.asm_connection import Connection
from escape_sim.emulators.asm_faults import Fault

#: How often the mirror looks after itself, seconds.
TICK_S = 0.02


class AsmServer:
    """Everything behind the port.

    Parameters
    ----------
    body
        The mirror.
    serial
        What it is called.
    faults
        What goes wrong at which of the owner's requests.
    versions
        Lowest and highest version that it speaks.

    Attributes
    ----------
    calls
        Every request of owners in order, as (name, what of it was told).
    complaints
        What clients did that a careful driver would not.
    """

    def __init__(
        self, body: AsmBody, serial: str, faults: dict[int, Fault], versions: tuple[int, int]
    ) -> None:
        self.body, self.serial, self.versions = body, serial, versions
        self.answers = Answers(body, serial)
        self.calls: list[tuple[str, object]] = []
        self.complaints: list[str] = []
        self.damaged = self.requests = 0
        self.owner: Connection | None = None
        #: Token of the last session and the last command's counter in it.
        self.token, self.counter = 0, 0
        self.connections: set[Connection] = set()
        self._faults = faults
        self._server: asyncio.Server | None = None
        self._ticking: asyncio.Task[None] | None = None

    # ------------------------------------------------------------------ listening
    async def listen(self, host: str, port: int) -> int:
        """Listen; returns the port.

        Raises
        ------
        OSError
            The address is taken or not ours.
        """
        loop = asyncio.get_running_loop()
        self._server = await loop.create_server(lambda: Connection(self), host, port)
        self._ticking = loop.create_task(self._tick())
        return int(self._server.sockets[0].getsockname()[1])

    async def hang_up(self) -> None:
        """Close every connection and the port."""
        if self._ticking is not None:
            self._ticking.cancel()
            await asyncio.gather(self._ticking, return_exceptions=True)
        for connection in list(self.connections):
            connection.abort()
        if self._server is not None:
            self._server.close()
            await self._server.wait_closed()

    def complain(self, words: str) -> None:
        """Write down what a client did wrong."""
        self.complaints.append(words)

    # ------------------------------------------------------------------ ownership
    def may_own(self, token: int) -> str:
        """Why a client with this token may not control the mirror; empty: it may."""
        if self.owner is None or token == self.token != 0:
            return ""
        return f"{self.owner.client} controls it"

    def enthrone(self, connection: Connection, token: int) -> None:
        """Make a connection the owner; a dead one of the same session is cut off."""
        former, self.owner = self.owner, connection
        if former is not None and former is not connection:
            former.abort()
        if token != self.token:
            self.token, self.counter = token, 0

    def gone(self, connection: Connection) -> None:
        """A connection has ended."""
        self.connections.discard(connection)
        if self.owner is connection:
            self.owner = None
            if self.body.shell.state is ShellState.RUNNING and not connection.severed:
                self.complain("the owner left the shell running")

    # ------------------------------------------------------------------ faults
    def next_fault(self) -> Fault | None:
        """What goes wrong at the owner's next request."""
        number, self.requests = self.requests, self.requests + 1
        return self._faults.get(number)

    def afflict(self, fault: Fault) -> None:
        """Have a fault of the mirror itself happen."""
        body, actuator = self.body, int(fault.value)
        if fault.kind == "skip":
            body.to_skip += 1
        elif fault.kind == "dust":
            body.contaminated.add(actuator)
        elif fault.kind == "stuck":
            body.shell.blind.add(actuator)
        elif fault.kind == "overcurrent":
            body.shell.excess_a[actuator] = 1.2
        elif fault.kind == "calm":
            body.shell.excess_a.clear()
            body.shell.blind.clear()
        elif fault.kind == "watchdog":
            body.rest_by_itself("the watchdog rested it, as arranged")
        elif fault.kind == "trip":
            body.trip("panic, as arranged")
            self._announce("panic, as arranged")

    # ------------------------------------------------------------------ by itself
    async def _tick(self) -> None:
        health_s = telemetry_s = heard_s = time.monotonic()
        while True:
            await asyncio.sleep(TICK_S)
            now = time.monotonic()
            if self.owner is not None:
                heard_s = self.owner.heard_s
            fault = self.body.tick(now, now - heard_s)
            if fault:
                self._announce(fault)
            if self.owner is not None and now - heard_s > self.body.limits.rest_s:
                self.complain(f"{self.owner.client} was silent for {self.body.limits.rest_s:g} s")
                self.owner.abort()
            if now - health_s >= 1.0:
                health_s = now
                self._tell_observers(w.HEALTH, self.answers.health(0, self.owner_name, self.damaged))
            if now - telemetry_s >= 1 / self.body.parameters["telemetry_hz"]:
                telemetry_s = now
                self._tell_observers(w.TELEM, self.answers.telemetry())

    @property
    def owner_name(self) -> str:
        """Who controls the mirror; empty: nobody."""
        return "" if self.owner is None else self.owner.client

    def _announce(self, fault: str) -> None:
        payload = self.answers.fault(fault)
        for connection in self.connections:
            connection.push(w.FAULT, payload)

    def _tell_observers(self, kind: int, payload: bytes) -> None:
        for connection in self.connections:
            if connection.observes:
                connection.push(kind, payload)
