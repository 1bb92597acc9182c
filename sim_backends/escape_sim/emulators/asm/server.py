"""TCP server of the emulated adaptive secondary: connections, one owner, observers, watchdog, link faults."""

from __future__ import annotations

import asyncio
import secrets
import socket
import struct
import time
from collections import deque
from dataclasses import dataclass
from typing import cast

import numpy as np

from escape_hw.api.adaptive_secondary import ShellState
from escape_hw.errors import ConfigError
from escape_sim.emulators.asm import protocol
from escape_sim.emulators.asm.controller import AsmController
from escape_sim.emulators.asm.replies import STATES, ReplyWriter
from escape_sim.emulators.options import current_word

#: Period of the mirror's own checks in seconds.
TICK_S = 0.02
#: Newest requests that are kept.
MAX_CALLS = 20_000
#: Roles of a client, and mode of a command in absolute positions.
_CONTROL, _TELEMETRY, _ABSOLUTE = 0, 1, 0
#: Kinds of fault, and whether they take a value.
FAULT_KINDS = {
    # The request is not processed.
    "close": False, "reset": False, "stall": False,
    # The request is processed and its reply is changed.
    "delay": True, "truncate": False, "crc": False, "stale": False, "double": False, "garbage": False,
    # The mirror; ``clear`` ends over-currents and unreadable sensors.
    "skip": False, "contaminate": True, "unreadable": True, "overcurrent": True, "watchdog": False,
    "trip": False, "clear": False,
}  # fmt: skip
_CONNECTION_FAULTS = ("close", "reset", "stall")
_RENAMED_FAULTS = {
    "silent": "stall", "half": "truncate", "dust": "contaminate", "stuck": "unreadable", "calm": "clear",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class AsmFault:
    """A fault of a kind of :data:`FAULT_KINDS`, with its value (number of an actuator, or seconds)."""

    kind: str
    value: float = 0.0

    @classmethod
    def from_text(cls, text: str) -> AsmFault:
        """Parse a fault such as ``contaminate:17`` or ``reset``; raises ``ConfigError`` if it is none."""
        kind, colon, value = text.strip().partition(":")
        kind = current_word(kind, _RENAMED_FAULTS)
        if kind not in FAULT_KINDS or bool(colon) != FAULT_KINDS[kind]:
            forms = ", ".join(f"{name}:VALUE" if takes else name for name, takes in FAULT_KINDS.items())
            raise ConfigError(f"fault {text!r}: write one of {forms}")
        try:
            return cls(kind, float(value or 0))
        except ValueError as error:
            raise ConfigError(f"fault {text!r}: {value!r} is not a number") from error


class AsmConnection(asyncio.Protocol):
    """Decodes requests, sends the replies of the server, and applies scripted faults of the link.

    Attributes
    ----------
    client, role
        Name of the client, and its role: -1 before ``HELLO``.
    sequence_in, sent_ns
        Sequence number and time stamp of the last request.
    closed_by_server
        Whether the server, and not the client, ended the connection.
    last_frame_s
        Time of the last valid frame, monotonic seconds.
    """

    def __init__(self, handler: AsmServer) -> None:
        self._handler = handler
        self._transport: asyncio.Transport | None = None
        self._received = bytearray()
        self._sequence_out = 0
        self._last_reply: tuple[int, bytes] | None = None
        self._is_write_paused, self._pending = False, b""
        self._is_stalled = False
        self.client, self.role = "unnamed client", -1
        self.sequence_in = self.sent_ns = 0
        self.closed_by_server = False
        self.last_frame_s = time.monotonic()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """A client has connected."""
        self._transport = cast(asyncio.Transport, transport)
        transport.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._handler.connection_made(self)

    def connection_lost(self, error: Exception | None) -> None:
        """The connection has ended."""
        self._transport = None
        self._handler.connection_lost(self)

    def pause_writing(self) -> None:
        """The client reads more slowly than messages are sent."""
        self._is_write_paused = True

    def resume_writing(self) -> None:
        """The client reads again; send the newest of the messages that it missed."""
        self._is_write_paused = False
        pending, self._pending = self._pending, b""
        self._write(pending)

    def abort(self) -> None:
        """Reset the connection."""
        self.closed_by_server = True
        if self._transport is not None:
            self._transport.abort()

    def send_unsolicited(self, kind: int, payload: bytes) -> None:
        """Send a message without request; a slow client gets only the newest."""
        if self.role < 0 or self._is_stalled:
            return
        data = self._encode_next_frame(kind, payload)
        if self._is_write_paused:
            self._pending = data
        else:
            self._write(data)

    def _encode_next_frame(self, kind: int, payload: bytes) -> bytes:
        self._sequence_out += 1
        return protocol.encode_frame(kind, self._sequence_out, time.monotonic_ns(), payload)

    def _write(self, data: bytes) -> None:
        if self._transport is not None and data:
            self._transport.write(data)

    def data_received(self, data: bytes) -> None:
        """Process every complete request; of several commands at once only the newest is applied."""
        if self._is_stalled:
            return
        self._received += data
        requests: list[protocol.AsmRequest] = []
        damage = ""
        try:
            while (request := protocol.decode_frame(self._received)) is not None:
                requests.append(request)
        except protocol.DamagedFrame as error:
            damage = str(error)
        if len(requests) > 1:
            self._handler.report_violation(f"{self.client} did not wait for a reply")
        newest = max((i for i, r in enumerate(requests) if r.kind == protocol.COMMAND), default=-1)
        for number, request in enumerate(requests):
            if self._transport is None or self._transport.is_closing() or self._is_stalled:
                return
            self._process(request, superseded=request.kind == protocol.COMMAND and number != newest)
        if damage:
            self._handler.report_damaged_frame(self, damage)
            self.abort()

    def _process(self, request: protocol.AsmRequest, superseded: bool) -> None:
        received_ns = time.monotonic_ns()
        fault = self._handler.next_fault(self)
        if fault is not None and fault.kind in _CONNECTION_FAULTS:
            self._apply_connection_fault(fault.kind)
            return
        kind, payload = self._handler.handle(self, request, superseded, received_ns)
        self.last_frame_s = time.monotonic()
        self._send_reply(kind, payload, fault)

    def _apply_connection_fault(self, kind: str) -> None:
        self.closed_by_server = kind != "stall"
        if kind == "stall":
            self._is_stalled = True
        elif self._transport is not None and kind == "close":
            self._transport.close()
        elif self._transport is not None:
            # Without linger time, closing resets the connection.
            linger = struct.pack("ii", 1, 0)
            self._transport.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, linger)
            self.abort()

    def _send_reply(self, kind: int, payload: bytes, fault: AsmFault | None) -> None:
        """Send a reply, as changed by a fault."""
        data = self._encode_next_frame(kind, payload)
        fault_kind = "" if fault is None else fault.kind
        last, self._last_reply = self._last_reply, (kind, payload)
        if fault is not None and fault_kind == "delay":
            asyncio.get_running_loop().call_later(fault.value, self._write, data)
        elif fault_kind == "truncate":
            self._write(data[: len(data) // 2])
            self.closed_by_server = True
            if self._transport is not None:
                self._transport.close()
        elif fault_kind == "crc":
            self._write(data[:-1] + bytes([data[-1] ^ 0x55]))
        elif fault_kind == "stale":
            self._write(self._encode_next_frame(*last) if last is not None else b"")
        elif fault_kind == "double":
            self._write(data + data)
        elif fault_kind == "garbage":
            self._write(b"\x00\xffgarbage\x17" + data)
        else:
            self._write(data)


def _is_later(number: int, reference: int) -> bool:
    """Whether a 32-bit number, which wraps around, is later than another."""
    return 0 < (number - reference) & 0xFFFFFFFF < 1 << 31


class AsmServer:
    """Handles the requests of all clients; ``faults`` are by the number of the owner's request.

    Attributes
    ----------
    violations
        Violations of the protocol by clients.
    requests, damaged
        Numbers of the owners' requests and of damaged frames.
    token, counter
        Token of the last session and counter of the last command in it.
    """

    def __init__(
        self, controller: AsmController, serial: str, faults: dict[int, AsmFault], versions: tuple[int, int]
    ) -> None:
        self.controller, self.versions = controller, versions
        self.replies = ReplyWriter(controller, serial)
        self._calls: deque[tuple[str, object]] = deque(maxlen=MAX_CALLS)
        self.violations: list[str] = []
        self.damaged = self.requests = self.token = self.counter = 0
        self.owner: AsmConnection | None = None
        self.connections: set[AsmConnection] = set()
        self._faults = faults
        self._server: asyncio.Server | None = None
        self._tick_task: asyncio.Task[None] | None = None

    @property
    def calls(self) -> tuple[tuple[str, object], ...]:
        """The newest requests of owners in order, as (name, arguments)."""
        return tuple(self._calls)

    # ------------------------------------------------------------------ listening
    async def listen(self, host: str, port: int) -> int:
        """Listen; returns the port. Raises OSError if the address cannot be used."""
        loop = asyncio.get_running_loop()
        self._server = await loop.create_server(lambda: AsmConnection(self), host, port)
        self._tick_task = loop.create_task(self._tick())
        return int(self._server.sockets[0].getsockname()[1])

    async def shut_down(self) -> None:
        """Close every connection and the port."""
        if self._tick_task is not None:
            self._tick_task.cancel()
            await asyncio.gather(self._tick_task, return_exceptions=True)
        for connection in list(self.connections):
            connection.abort()
        if self._server is not None:
            self._server.close()
            await self._server.wait_closed()

    def connection_made(self, connection: AsmConnection) -> None:
        """A client has connected."""
        self.connections.add(connection)

    def connection_lost(self, connection: AsmConnection) -> None:
        """A connection has ended."""
        self.connections.discard(connection)
        if self.owner is connection:
            self.owner = None
            if self.controller.shell.state is ShellState.RUNNING and not connection.closed_by_server:
                self.report_violation("the owner left the shell running")

    def report_violation(self, message: str) -> None:
        """Record a violation of the protocol by a client."""
        self.violations.append(message)

    def report_damaged_frame(self, connection: AsmConnection, damage: str) -> None:
        """Count a damaged frame."""
        self.damaged += 1
        self.report_violation(f"{connection.client} sent a damaged frame: {damage}")

    # ------------------------------------------------------------------ requests
    def handle(
        self, connection: AsmConnection, request: protocol.AsmRequest, superseded: bool, received_ns: int
    ) -> tuple[int, bytes]:
        """Process a request; returns type and payload of the reply."""
        try:
            return self._check_and_handle(connection, request, superseded, received_ns)
        except (ValueError, struct.error, IndexError) as error:
            message = f"{request.name} is malformed ({error})"
            return self._refuse(connection, request, protocol.BAD_LENGTH, message)

    def _check_and_handle(
        self, connection: AsmConnection, request: protocol.AsmRequest, superseded: bool, received_ns: int
    ) -> tuple[int, bytes]:
        low, high = self.versions
        refusal: tuple[int, str] | None = None
        if request.kind != protocol.HELLO and not low <= request.version <= high:
            refusal = protocol.UNSUPPORTED, f"version {request.version} is not supported"
        elif not _is_later(request.sequence, connection.sequence_in):
            refusal = protocol.STALE, f"request {request.sequence} after {connection.sequence_in}"
        if refusal is not None:
            return self._refuse(connection, request, *refusal)
        connection.sequence_in = request.sequence
        if request.sent_ns < connection.sent_ns:
            self.report_violation(f"{connection.client}'s clock runs backwards")
        connection.sent_ns = request.sent_ns
        if request.kind == protocol.HELLO:
            return self._handle_hello(connection, request)
        if connection.role < 0:
            refusal = protocol.NOT_OWNER, f"{request.name} before HELLO"
        elif request.kind == protocol.GET_HEALTH:
            return protocol.HEALTH, self.replies.health(request.sequence, self.owner_name, self.damaged)
        elif connection is not self.owner:
            refusal = protocol.NOT_OWNER, f"{request.name} from an observer"
        elif superseded:
            refusal = protocol.STALE, "a newer command came with it"
        if refusal is not None:
            return self._refuse(connection, request, *refusal)
        return self._handle_owner_request(connection, request, received_ns)

    def _handle_hello(self, connection: AsmConnection, request: protocol.AsmRequest) -> tuple[int, bytes]:
        low, high, role, token, client = protocol.read_hello(request.payload)
        if connection.role >= 0:
            return self._refuse(connection, request, protocol.WRONG_STATE, "HELLO for the second time")
        connection.client = client or connection.client
        version = min(high, self.versions[1])
        if version < max(low, self.versions[0]):
            message = f"versions {self.versions[0]} to {self.versions[1]} are supported"
            return self._refuse(connection, request, protocol.UNSUPPORTED, message)
        if role == _CONTROL:
            resumes = token == self.token != 0
            if self.owner is not None and not resumes:
                message = f"{self.owner.client} controls it"
                return self._refuse(connection, request, protocol.NOT_OWNER, message)
            token = token if resumes else secrets.randbits(63) | 1
            self._set_owner(connection, token)
        elif role != _TELEMETRY:
            return self._refuse(connection, request, protocol.UNSUPPORTED, f"no role {role}")
        connection.role = role
        return protocol.WELCOME, self.replies.welcome(request.sequence, version, role, token)

    def _set_owner(self, connection: AsmConnection, token: int) -> None:
        """Make a connection the owner; an older connection of the same session is closed."""
        previous, self.owner = self.owner, connection
        if previous is not None and previous is not connection:
            previous.abort()
        if token != self.token:
            self.token, self.counter = token, 0

    def _handle_owner_request(
        self, connection: AsmConnection, request: protocol.AsmRequest, received_ns: int
    ) -> tuple[int, bytes]:
        controller, echo = self.controller, request.sequence
        if request.kind == protocol.COMMAND:
            return self._handle_command(connection, request, received_ns)
        if request.kind == protocol.HEARTBEAT:
            self._log_call(request, None)
            return protocol.ACK, self.replies.ack(echo, protocol.APPLIED, 0, received_ns)
        message = ""
        if request.kind == protocol.SET_STATE:
            (number,) = request.payload
            self._log_call(request, STATES[number])
            code, message = controller.request_state(STATES[number], time.monotonic())
            if code != protocol.APPLIED:
                return self._refuse(connection, request, code, message)
        elif request.kind == protocol.RECOVER:
            self._log_call(request, None)
            controller.recover()
        elif request.kind == protocol.SET_DISABLED:
            numbers, reason = protocol.read_disabled(request.payload)
            self._log_call(request, (tuple(sorted(numbers)), reason))
            if numbers and max(numbers) >= controller.shell.n_act:
                return self._refuse(connection, request, protocol.BAD_LENGTH, f"no actuator {max(numbers)}")
            controller.disabled = numbers
        else:
            return self._handle_parameter(connection, request)
        return protocol.DONE, self.replies.done(echo, message)

    def _handle_parameter(self, connection: AsmConnection, request: protocol.AsmRequest) -> tuple[int, bytes]:
        controller = self.controller
        if request.kind == protocol.SET_PARAM:
            (value,) = struct.unpack("<d", request.payload[:8])
            key = protocol.read_text(request.payload[8:])
            error = controller.set_parameter(key, value)
        elif request.kind == protocol.GET_PARAM:
            key = protocol.read_text(request.payload)
            error = "" if key in controller.parameters else f"no parameter {key!r}"
        else:
            return self._refuse(connection, request, protocol.UNSUPPORTED, f"{request.name} is unknown")
        self._log_call(request, key)
        if error:
            return self._refuse(connection, request, protocol.BAD_LENGTH, error)
        return protocol.PARAM, self.replies.parameter(request.sequence, key)

    def _handle_command(
        self, connection: AsmConnection, request: protocol.AsmRequest, received_ns: int
    ) -> tuple[int, bytes]:
        controller, shell = self.controller, self.controller.shell
        decoded = protocol.read_command(request.payload, shell.n_act)
        if decoded is None:
            message = f"{len(request.payload)} bytes of command"
            return self._refuse(connection, request, protocol.BAD_LENGTH, message)
        counter, mode, metres = decoded
        if not _is_later(counter, self.counter):
            return self._refuse(
                connection, request, protocol.STALE, f"command {counter} after {self.counter}"
            )
        self.counter = counter
        self._log_call(request, metres.copy())
        if not np.isfinite(metres).all():
            return self._refuse(connection, request, protocol.NOT_FINITE, "a value is not finite")
        # A client cannot foresee that the mirror has tripped or rested on its own.
        if shell.state is ShellState.FAULT:
            return self._nak(request, protocol.PANIC, shell.fault)
        if shell.state is not ShellState.RUNNING and controller.last_event:
            return self._nak(request, protocol.WRONG_STATE, controller.last_event)
        if shell.state is not ShellState.RUNNING:
            return self._refuse(connection, request, protocol.WRONG_STATE, f"it is {shell.state}")
        result, clipped = controller.command(metres, absolute=mode == _ABSOLUTE)
        return protocol.ACK, self.replies.ack(request.sequence, result, clipped, received_ns)

    def _log_call(self, request: protocol.AsmRequest, arguments: object) -> None:
        self._calls.append((request.name, arguments))

    def _refuse(
        self, connection: AsmConnection, request: protocol.AsmRequest, code: int, message: str
    ) -> tuple[int, bytes]:
        """Refuse a request that a correct client would not send."""
        self.report_violation(f"{connection.client}: {request.name} refused: {message}")
        return self._nak(request, code, message)

    def _nak(self, request: protocol.AsmRequest, code: int, message: str) -> tuple[int, bytes]:
        return protocol.NAK, self.replies.nak(request.sequence, code, message)

    # ------------------------------------------------------------------ faults
    def next_fault(self, connection: AsmConnection) -> AsmFault | None:
        """Fault of the link for the owner's next request; faults of the mirror are applied."""
        if connection is not self.owner:
            return None
        number, self.requests = self.requests, self.requests + 1
        fault = self._faults.get(number)
        if fault is not None:
            self.apply_mirror_fault(fault)
        return fault

    def apply_mirror_fault(self, fault: AsmFault) -> None:
        """Apply a fault of the mirror; other kinds are ignored."""
        controller, actuator = self.controller, int(fault.value)
        if fault.kind == "skip":
            controller.pending_skips += 1
        elif fault.kind == "contaminate":
            controller.contaminated.add(actuator)
        elif fault.kind == "unreadable":
            controller.shell.unreadable.add(actuator)
        elif fault.kind == "overcurrent":
            controller.shell.excess_a[actuator] = 1.2
        elif fault.kind == "clear":
            controller.shell.excess_a.clear()
            controller.shell.unreadable.clear()
        elif fault.kind == "watchdog":
            controller.rest_autonomously("the watchdog rested it (scripted)")
        elif fault.kind == "trip":
            controller.trip("panic (scripted)")
            self._broadcast_fault("panic (scripted)")

    # ------------------------------------------------------------------ periodic tasks
    async def _tick(self) -> None:
        health_s = telemetry_s = last_frame_s = time.monotonic()
        rest_s = self.controller.limits.rest_s
        while True:
            await asyncio.sleep(TICK_S)
            now = time.monotonic()
            if self.owner is not None:
                last_frame_s = self.owner.last_frame_s
            fault = self.controller.tick(now, now - last_frame_s)
            if fault:
                self._broadcast_fault(fault)
            if self.owner is not None and now - last_frame_s > rest_s:
                self.report_violation(f"{self.owner.client} was silent for {rest_s:g} s")
                self.owner.abort()
            if now - health_s >= 1.0:
                health_s = now
                health = self.replies.health(0, self.owner_name, self.damaged)
                self._send_to_observers(protocol.HEALTH, health)
            if now - telemetry_s >= 1 / self.controller.parameters["telemetry_hz"]:
                telemetry_s = now
                self._send_to_observers(protocol.TELEM, self.replies.telemetry())

    @property
    def owner_name(self) -> str:
        """Name of the client that controls the mirror; empty without one."""
        return "" if self.owner is None else self.owner.client

    def _broadcast_fault(self, fault: str) -> None:
        payload = self.replies.fault(fault)
        for connection in self.connections:
            connection.send_unsolicited(protocol.FAULT, payload)

    def _send_to_observers(self, kind: int, payload: bytes) -> None:
        for connection in self.connections:
            if connection.role == _TELEMETRY:
                connection.send_unsolicited(kind, payload)
