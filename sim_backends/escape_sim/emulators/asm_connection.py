"""One TCP connection to the emulated adaptive secondary."""

from __future__ import annotations

import asyncio
import secrets
import socket
import struct
import time
from typing import TYPE_CHECKING, cast

import numpy as np

from escape_hw.api.adaptive_secondary import ShellState
from escape_sim.emulators import asm_wire as w
from escape_sim.emulators.asm_answers import STATES
from escape_sim.emulators.asm_faults import Fault

if TYPE_CHECKING:
    from escape_sim.emulators.asm_server import AsmServer

_CONTROL, _TELEMETRY = 0, 1
_ABSOLUTE = 0
_OF_THE_MIRROR = ("skip", "dust", "stuck", "overcurrent", "watchdog", "trip", "calm")


def _later(number: int, than: int) -> bool:
    """True when a number that begins anew after 2**32 is later than another."""
    return 0 < (number - than) & 0xFFFFFFFF < 1 << 31


class Connection(asyncio.Protocol):
    """Reads requests, answers them, and plays the faults of the script.

    Parameters
    ----------
    server
        What it belongs to.
    """

    def __init__(self, server: AsmServer) -> None:
        self._server, self._body = server, server.body
        self._transport: asyncio.Transport | None = None
        self._arrived = bytearray()
        self._sequence_in = self._sequence_out = self._sent_ns = 0
        self._last_answer: tuple[int, bytes] | None = None
        self._paused, self._waiting = False, b""
        self._silent = False
        self.client, self.role = "somebody", -1
        #: It was not the client that ended the connection.
        self.severed = False
        #: When the last sound frame came, monotonic seconds.
        self.heard_s = time.monotonic()

    # ------------------------------------------------------------------ transport
    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """A client has connected."""
        self._transport = cast(asyncio.Transport, transport)
        self._server.connections.add(self)
        peer = transport.get_extra_info("socket")
        peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def connection_lost(self, error: Exception | None) -> None:
        """The connection has ended."""
        self._transport = None
        self._server.gone(self)

    def pause_writing(self) -> None:
        """The client does not read as fast as it is told."""
        self._paused = True

    def resume_writing(self) -> None:
        """The client reads again: it gets the newest of what it missed."""
        self._paused = False
        waiting, self._waiting = self._waiting, b""
        self._write(waiting)

    def abort(self) -> None:
        """Reset the connection."""
        self.severed = True
        if self._transport is not None:
            self._transport.abort()

    @property
    def observes(self) -> bool:
        """True for a connection that watches."""
        return self.role == _TELEMETRY

    def push(self, kind: int, payload: bytes) -> None:
        """Say something unasked; to who does not keep up, only the newest."""
        if self.role < 0 or self._silent:
            return
        data = self._framed(kind, payload)
        if self._paused:
            self._waiting = data
        else:
            self._write(data)

    def _framed(self, kind: int, payload: bytes) -> bytes:
        self._sequence_out += 1
        return w.framed(kind, self._sequence_out, time.monotonic_ns(), payload)

    def _write(self, data: bytes) -> None:
        if self._transport is not None and data:
            self._transport.write(data)

    # ------------------------------------------------------------------ requests
    def data_received(self, data: bytes) -> None:
        """Answer every whole request; of several commands at once only the newest counts."""
        if self._silent:
            return
        self._arrived += data
        requests: list[w.Request] = []
        damage = ""
        try:
            while (request := w.take(self._arrived)) is not None:
                requests.append(request)
        except w.Damaged as error:
            damage = str(error)
        if len(requests) > 1:
            self._server.complain(f"{self.client} did not wait for an answer")
        newest = max((i for i, r in enumerate(requests) if r.kind == w.COMMAND), default=-1)
        for number, request in enumerate(requests):
            if self._transport is None or self._transport.is_closing() or self._silent:
                return
            self._serve(request, superseded=request.kind == w.COMMAND and number != newest)
        if damage:
            self._server.damaged += 1
            self._server.complain(f"{self.client} sent a damaged frame: {damage}")
            self.abort()

    def _serve(self, request: w.Request, superseded: bool) -> None:
        received_ns = time.monotonic_ns()
        fault = self._server.next_fault() if self is self._server.owner else None
        if fault is not None and self._cut(fault):
            return
        if fault is not None and fault.kind in _OF_THE_MIRROR:
            self._server.afflict(fault)
        try:
            kind, payload = self._answer(request, superseded, received_ns)
        except (ValueError, struct.error, IndexError) as error:
            kind, payload = self._refuse(request, w.BAD_LENGTH, f"{request.name} makes no sense ({error})")
        self.heard_s = time.monotonic()
        self._deliver(kind, payload, fault)

    def _answer(self, request: w.Request, superseded: bool, received_ns: int) -> tuple[int, bytes]:
        low, high = self._server.versions
        if request.kind != w.HELLO and not low <= request.version <= high:
            return self._refuse(request, w.UNSUPPORTED, f"version {request.version} is not spoken here")
        if not _later(request.sequence, self._sequence_in):
            return self._refuse(request, w.STALE, f"request {request.sequence} after {self._sequence_in}")
        self._sequence_in = request.sequence
        if request.sent_ns < self._sent_ns:
            self._server.complain(f"{self.client}'s clock runs backwards")
        self._sent_ns = request.sent_ns
        if request.kind == w.HELLO:
            return self._greet(request)
        if self.role < 0:
            return self._refuse(request, w.NOT_OWNER, f"{request.name} before HELLO")
        if request.kind == w.GET_HEALTH:
            return w.HEALTH, self._server.answers.health(
                request.sequence, self._server.owner_name, self._server.damaged
            )
        if self is not self._server.owner:
            return self._refuse(request, w.NOT_OWNER, f"{request.name} from who only watches")
        if superseded:
            return self._refuse(request, w.STALE, "a newer command came with it")
        return self._obey(request, received_ns)

    def _greet(self, request: w.Request) -> tuple[int, bytes]:
        server = self._server
        low, high, role, token, client = w.read_hello(request.payload)
        if self.role >= 0:
            return self._refuse(request, w.WRONG_STATE, "HELLO for the second time")
        self.client = client or self.client
        version = min(high, server.versions[1])
        if version < max(low, server.versions[0]):
            words = f"versions {server.versions[0]} to {server.versions[1]} are spoken here"
            return self._refuse(request, w.UNSUPPORTED, words)
        if role == _CONTROL:
            reason = server.may_own(token)
            if reason:
                return self._refuse(request, w.NOT_OWNER, reason)
            token = token if token == server.token != 0 else secrets.randbits(63) | 1
            server.enthrone(self, token)
        elif role != _TELEMETRY:
            return self._refuse(request, w.UNSUPPORTED, f"no role {role}")
        self.role = role
        return w.WELCOME, server.answers.welcome(request.sequence, version, role, token)

    def _obey(self, request: w.Request, received_ns: int) -> tuple[int, bytes]:
        """What only the owner may ask for."""
        body, answers, echo = self._body, self._server.answers, request.sequence
        if request.kind == w.COMMAND:
            return self._command(request, received_ns)
        if request.kind == w.HEARTBEAT:
            self._note(request, None)
            return w.ACK, answers.ack(echo, w.APPLIED, 0, received_ns)
        if request.kind == w.SET_STATE:
            (number,) = request.payload
            self._note(request, STATES[number])
            code, words = body.ask_state(STATES[number], time.monotonic())
            if code != w.APPLIED:
                return self._refuse(request, code, words)
            return w.DONE, answers.done(echo, words)
        if request.kind == w.RECOVER:
            self._note(request, None)
            body.recover()
            return w.DONE, answers.done(echo, "")
        if request.kind == w.SET_DISABLED:
            numbers, reason = w.read_disabled(request.payload)
            self._note(request, (tuple(sorted(numbers)), reason))
            if numbers and max(numbers) >= body.shell.n_act:
                return self._refuse(request, w.BAD_LENGTH, f"no actuator {max(numbers)}")
            body.disabled = numbers
            return w.DONE, answers.done(echo, "")
        return self._parameter(request)

    def _parameter(self, request: w.Request) -> tuple[int, bytes]:
        body = self._body
        if request.kind == w.SET_PARAM:
            (value,) = struct.unpack("<d", request.payload[:8])
            key = w.read_text(request.payload[8:])
            wrong = body.set_parameter(key, value)
        elif request.kind == w.GET_PARAM:
            key = w.read_text(request.payload)
            wrong = "" if key in body.parameters else f"no parameter {key!r}"
        else:
            return self._refuse(request, w.UNSUPPORTED, f"{request.name} is unknown here")
        self._note(request, key)
        if wrong:
            return self._refuse(request, w.BAD_LENGTH, wrong)
        return w.PARAM, self._server.answers.parameter(request.sequence, key)

    def _command(self, request: w.Request, received_ns: int) -> tuple[int, bytes]:
        body, server = self._body, self._server
        found = w.read_command(request.payload, body.shell.n_act)
        if found is None:
            return self._refuse(request, w.BAD_LENGTH, f"{len(request.payload)} bytes of command")
        counter, mode, metres = found
        if not _later(counter, server.counter):
            return self._refuse(request, w.STALE, f"command {counter} after {server.counter}")
        server.counter = counter
        self._note(request, metres.copy())
        if not np.isfinite(metres).all():
            return self._refuse(request, w.NOT_FINITE, "a value is not finite")
        if body.shell.state is ShellState.FAULT:
            return self._refuse(request, w.PANIC, body.shell.fault, complain=False)
        if body.shell.state is not ShellState.RUNNING:
            note = body.note or f"it is {body.shell.state}"
            return self._refuse(request, w.WRONG_STATE, note, complain=not body.note)
        result, clipped = body.command(metres, absolute=mode == _ABSOLUTE)
        return w.ACK, server.answers.ack(request.sequence, result, clipped, received_ns)

    def _note(self, request: w.Request, what: object) -> None:
        self._server.calls.append((request.name, what))

    def _refuse(self, request: w.Request, code: int, words: str, complain: bool = True) -> tuple[int, bytes]:
        if complain:
            self._server.complain(f"{self.client}: {request.name} refused: {words}")
        return w.NAK, self._server.answers.nak(request.sequence, code, words)

    # ------------------------------------------------------------------ faults of the wire
    def _cut(self, fault: Fault) -> bool:
        """Play a fault that keeps a request from being looked at."""
        if self._transport is None or fault.kind not in ("close", "reset", "silent"):
            return False
        self.severed = fault.kind != "silent"
        if fault.kind == "close":
            self._transport.close()
        elif fault.kind == "reset":
            lingering = struct.pack("ii", 1, 0)
            self._transport.get_extra_info("socket").setsockopt(
                socket.SOL_SOCKET, socket.SO_LINGER, lingering
            )
            self.abort()
        else:
            self._silent = True
        return True

    def _deliver(self, kind: int, payload: bytes, fault: Fault | None) -> None:
        """Send an answer, or what a fault makes of it."""
        data = self._framed(kind, payload)
        play = "" if fault is None else fault.kind
        last, self._last_answer = self._last_answer, (kind, payload)
        if play == "delay" and fault is not None:
            asyncio.get_running_loop().call_later(fault.value, self._write, data)
        elif play == "half":
            self._write(data[: len(data) // 2])
            self.severed = True
            if self._transport is not None:
                self._transport.close()
        elif play == "crc":
            self._write(data[:-1] + bytes([data[-1] ^ 0x55]))
        elif play == "stale":
            self._write(self._framed(*last) if last is not None else b"")
        elif play == "double":
            self._write(data + data)
        elif play == "garbage":
            self._write(b"\x00\xffgarbage\x17" + data)
        else:
            self._write(data)
