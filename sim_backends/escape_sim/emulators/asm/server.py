"""TCP server of the emulated adaptive secondary: one owner, many observers, replies, scripted faults."""

from __future__ import annotations

import asyncio
import secrets
import socket
import struct
import time
from dataclasses import dataclass
from typing import cast

import numpy as np

from escape_hw.api.adaptive_secondary import STATE_ORDER, ShellState
from escape_hw.errors import ConfigError
from escape_sim.emulators.asm import protocol
from escape_sim.emulators.asm.controller import AsmController
from escape_sim.mirror.shell import AMBIENT_C, RISE_C_PER_A

#: What may happen at a request, and whether it takes a value.
FAULT_KINDS = {
    # Before the request is looked at.
    "close": False, "reset": False, "silent": False,
    # To the answer of a request that was carried out.
    "delay": True, "half": False, "crc": False, "stale": False, "double": False, "garbage": False,
    # To the mirror; calm ends over-currents and blindness.
    "skip": False, "dust": True, "stuck": True, "overcurrent": True, "watchdog": False, "trip": False,
    "calm": False,
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class AsmFault:
    """One fault: what, with which value (a number of an actuator, seconds)."""

    kind: str
    value: float = 0.0

    @classmethod
    def from_text(cls, text: str) -> AsmFault:
        """``dust:17`` or ``reset`` as a fault.

        Raises
        ------
        ConfigError
            Not of that form.
        """
        kind, colon, value = text.strip().partition(":")
        if kind not in FAULT_KINDS or bool(colon) != FAULT_KINDS[kind]:
            forms = ", ".join(f"{name}:VALUE" if takes else name for name, takes in FAULT_KINDS.items())
            raise ConfigError(f"fault {text!r}: write one of {forms}")
        try:
            return cls(kind, float(value or 0))
        except ValueError as error:
            raise ConfigError(f"fault {text!r}: {value!r} is no number") from error


def parse_fault_script(script: str) -> dict[int, AsmFault]:
    """``skip@3,dust:17@40`` as faults by the number of the owner's request, counted from 0.

    Raises
    ------
    ConfigError
        Not of that form.
    """
    faults: dict[int, AsmFault] = {}
    for part in filter(None, script.split(",")):
        text, _, at = part.partition("@")
        if not at.isdigit():
            raise ConfigError(f"fault {part!r}: write KIND@NUMBER, NUMBER that of the request")
        faults[int(at)] = AsmFault.from_text(text)
    return faults


#: States as the wire numbers them.
STATES = [*STATE_ORDER, ShellState.FAULT]
#: Sensors that have no physics here: coolant and dew point in degrees Celsius, relative humidity.
COOLANT_C, HUMIDITY, DEW_POINT_C = 12.0, 0.3, 2.0


class ReplyWriter:
    """Writes payloads from the mirror's present state.

    Parameters
    ----------
    body
        The mirror.
    serial
        What it is called.
    """

    def __init__(self, controller: AsmController, serial: str) -> None:
        self._controller, self._serial = controller, serial

    @property
    def _state(self) -> int:
        return STATES.index(self._controller.shell.state)

    def welcome(self, echo: int, version: int, role: int, token: int) -> bytes:
        """Who the mirror is."""
        controller, limits = self._controller, self._controller.limits
        n_act = controller.shell.n_act
        fixed = struct.pack(
            "<IBBBBHHQffff", echo, version, role, self._state, 1, n_act, 0, token,
            limits.max_command_m, limits.max_step_m, limits.hold_s, limits.rest_s,
        )  # fmt: skip
        return (
            fixed
            + protocol.encode_text(self._serial)
            + protocol.encode_bitmap(controller.out_of_service, n_act)
            + protocol.encode_floats(controller.present_m)
        )

    def ack(self, echo: int, result: int, clipped: int, received_ns: int) -> bytes:
        """A command or heartbeat was taken, with positions."""
        controller = self._controller
        flags = int(controller.holding)
        fixed = struct.pack(
            "<IHBBHHQQ", echo, result, self._state, flags, clipped, 0, received_ns, time.monotonic_ns()
        )
        return fixed + protocol.encode_floats(controller.positions_m())

    def nak(self, echo: int, code: int, message: str) -> bytes:
        """A request was refused."""
        return struct.pack("<IHBB", echo, code, self._state, 0) + protocol.encode_text(message)

    def done(self, echo: int, message: str) -> bytes:
        """A request was accepted."""
        return struct.pack("<IB", echo, self._state) + protocol.encode_text(message)

    def parameter(self, echo: int, key: str) -> bytes:
        """A parameter in force."""
        return struct.pack("<Id", echo, self._controller.parameters[key]) + protocol.encode_text(key)

    def fault(self, message: str) -> bytes:
        """The mirror has stopped itself."""
        return bytes([self._state]) + protocol.encode_text(message)

    def health(self, echo: int, owner: str, damaged: int) -> bytes:
        """How the mirror is."""
        controller, shell = self._controller, self._controller.shell
        current = float(shell.currents_a().max())
        fixed = struct.pack(
            "<IBxxxQffffffIII", echo, self._state, time.monotonic_ns(),
            shell.gap_m(), current, AMBIENT_C + RISE_C_PER_A * current, COOLANT_C, HUMIDITY, DEW_POINT_C,
            controller.applied & 0xFFFFFFFF, controller.skipped & 0xFFFFFFFF, damaged & 0xFFFFFFFF,
        )  # fmt: skip
        return (
            fixed
            + protocol.encode_bitmap(controller.contaminated, shell.n_act)
            + protocol.encode_text(owner)
            + protocol.encode_text(shell.fault or controller.note)
        )

    def telemetry(self) -> bytes:
        """A sample for observers."""
        controller = self._controller
        fixed = struct.pack(
            "<IBxHQ",
            controller.applied & 0xFFFFFFFF,
            self._state,
            controller.shell.n_act,
            time.monotonic_ns(),
        )
        flags: bytes = controller.flags().tobytes()
        shape = controller.present_m.copy()
        unused = sorted(controller.out_of_service)
        if unused:
            # No force acts there; the shell goes where its neighbours take it.
            numbers = np.arange(shape.size)
            shape[unused] = np.interp(unused, np.delete(numbers, unused), np.delete(shape, unused))
        return (
            fixed
            + protocol.encode_floats(shape)
            + protocol.encode_floats(controller.positions_m())
            + protocol.encode_floats(controller.shell.currents_a())
            + flags
        )


_CONTROL, _TELEMETRY = 0, 1
_ABSOLUTE = 0
_MIRROR_FAULTS = ("skip", "dust", "stuck", "overcurrent", "watchdog", "trip", "calm")


def _is_later(number: int, than: int) -> bool:
    """True when a number that begins anew after 2**32 is later than another."""
    return 0 < (number - than) & 0xFFFFFFFF < 1 << 31


class AsmConnection(asyncio.Protocol):
    """Reads requests, answers them, and plays the faults of the script.

    Parameters
    ----------
    server
        What it belongs to.
    """

    def __init__(self, server: AsmServer) -> None:
        self._server, self._controller = server, server.controller
        self._transport: asyncio.Transport | None = None
        self._received = bytearray()
        self._sequence_in = self._sequence_out = self._sent_ns = 0
        self._last_reply: tuple[int, bytes] | None = None
        self._is_write_paused, self._pending = False, b""
        self._is_muted = False
        self.client, self.role = "somebody", -1
        #: It was not the client that ended the connection.
        self.closed_by_server = False
        #: When the last sound frame came, monotonic seconds.
        self.last_frame_s = time.monotonic()

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
        self._server.remove_connection(self)

    def pause_writing(self) -> None:
        """The client does not read as fast as it is told."""
        self._is_write_paused = True

    def resume_writing(self) -> None:
        """The client reads again: it gets the newest of what it missed."""
        self._is_write_paused = False
        waiting, self._pending = self._pending, b""
        self._write(waiting)

    def abort(self) -> None:
        """Reset the connection."""
        self.closed_by_server = True
        if self._transport is not None:
            self._transport.abort()

    @property
    def is_observer(self) -> bool:
        """True for a connection that watches."""
        return self.role == _TELEMETRY

    def send_unsolicited(self, kind: int, payload: bytes) -> None:
        """Say something unasked; to who does not keep up, only the newest."""
        if self.role < 0 or self._is_muted:
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

    # ------------------------------------------------------------------ requests
    def data_received(self, data: bytes) -> None:
        """Answer every whole request; of several commands at once only the newest counts."""
        if self._is_muted:
            return
        self._received += data
        requests: list[protocol.AsmRequest] = []
        damage_text = ""
        try:
            while (request := protocol.decode_frame(self._received)) is not None:
                requests.append(request)
        except protocol.DamagedFrame as error:
            damage_text = str(error)
        if len(requests) > 1:
            self._server.report_violation(f"{self.client} did not wait for an answer")
        newest = max((i for i, r in enumerate(requests) if r.kind == protocol.COMMAND), default=-1)
        for number, request in enumerate(requests):
            if self._transport is None or self._transport.is_closing() or self._is_muted:
                return
            self._process_request(request, superseded=request.kind == protocol.COMMAND and number != newest)
        if damage_text:
            self._server.damaged += 1
            self._server.report_violation(f"{self.client} sent a damaged frame: {damage_text}")
            self.abort()

    def _process_request(self, request: protocol.AsmRequest, superseded: bool) -> None:
        received_ns = time.monotonic_ns()
        fault = self._server.next_fault() if self is self._server.owner else None
        if fault is not None and self._apply_connection_fault(fault):
            return
        if fault is not None and fault.kind in _MIRROR_FAULTS:
            self._server.apply_mirror_fault(fault)
        try:
            kind, payload = self._handle_request(request, superseded, received_ns)
        except (ValueError, struct.error, IndexError) as error:
            kind, payload = self._refuse(
                request, protocol.BAD_LENGTH, f"{request.name} makes no sense ({error})"
            )
        self.last_frame_s = time.monotonic()
        self._send_reply(kind, payload, fault)

    def _handle_request(
        self, request: protocol.AsmRequest, superseded: bool, received_ns: int
    ) -> tuple[int, bytes]:
        low, high = self._server.versions
        if request.kind != protocol.HELLO and not low <= request.version <= high:
            return self._refuse(
                request, protocol.UNSUPPORTED, f"version {request.version} is not spoken here"
            )
        if not _is_later(request.sequence, self._sequence_in):
            return self._refuse(
                request, protocol.STALE, f"request {request.sequence} after {self._sequence_in}"
            )
        self._sequence_in = request.sequence
        if request.sent_ns < self._sent_ns:
            self._server.report_violation(f"{self.client}'s clock runs backwards")
        self._sent_ns = request.sent_ns
        if request.kind == protocol.HELLO:
            return self._handle_hello(request)
        if self.role < 0:
            return self._refuse(request, protocol.NOT_OWNER, f"{request.name} before HELLO")
        if request.kind == protocol.GET_HEALTH:
            return protocol.HEALTH, self._server.replies.health(
                request.sequence, self._server.owner_name, self._server.damaged
            )
        if self is not self._server.owner:
            return self._refuse(request, protocol.NOT_OWNER, f"{request.name} from who only watches")
        if superseded:
            return self._refuse(request, protocol.STALE, "a newer command came with it")
        return self._handle_owner_request(request, received_ns)

    def _handle_hello(self, request: protocol.AsmRequest) -> tuple[int, bytes]:
        server = self._server
        low, high, role, token, client = protocol.read_hello(request.payload)
        if self.role >= 0:
            return self._refuse(request, protocol.WRONG_STATE, "HELLO for the second time")
        self.client = client or self.client
        version = min(high, server.versions[1])
        if version < max(low, server.versions[0]):
            message = f"versions {server.versions[0]} to {server.versions[1]} are spoken here"
            return self._refuse(request, protocol.UNSUPPORTED, message)
        if role == _CONTROL:
            reason = server.ownership_refusal(token)
            if reason:
                return self._refuse(request, protocol.NOT_OWNER, reason)
            token = token if token == server.token != 0 else secrets.randbits(63) | 1
            server.set_owner(self, token)
        elif role != _TELEMETRY:
            return self._refuse(request, protocol.UNSUPPORTED, f"no role {role}")
        self.role = role
        return protocol.WELCOME, server.replies.welcome(request.sequence, version, role, token)

    def _handle_owner_request(self, request: protocol.AsmRequest, received_ns: int) -> tuple[int, bytes]:
        """What only the owner may ask for."""
        controller, replies, echo = self._controller, self._server.replies, request.sequence
        if request.kind == protocol.COMMAND:
            return self._handle_command(request, received_ns)
        if request.kind == protocol.HEARTBEAT:
            self._log_request(request, None)
            return protocol.ACK, replies.ack(echo, protocol.APPLIED, 0, received_ns)
        if request.kind == protocol.SET_STATE:
            (number,) = request.payload
            self._log_request(request, STATES[number])
            code, message = controller.request_state(STATES[number], time.monotonic())
            if code != protocol.APPLIED:
                return self._refuse(request, code, message)
            return protocol.DONE, replies.done(echo, message)
        if request.kind == protocol.RECOVER:
            self._log_request(request, None)
            controller.recover()
            return protocol.DONE, replies.done(echo, "")
        if request.kind == protocol.SET_DISABLED:
            numbers, reason = protocol.read_disabled(request.payload)
            self._log_request(request, (tuple(sorted(numbers)), reason))
            if numbers and max(numbers) >= controller.shell.n_act:
                return self._refuse(request, protocol.BAD_LENGTH, f"no actuator {max(numbers)}")
            controller.disabled = numbers
            return protocol.DONE, replies.done(echo, "")
        return self._handle_parameter(request)

    def _handle_parameter(self, request: protocol.AsmRequest) -> tuple[int, bytes]:
        controller = self._controller
        if request.kind == protocol.SET_PARAM:
            (value,) = struct.unpack("<d", request.payload[:8])
            key = protocol.read_text(request.payload[8:])
            reason = controller.set_parameter(key, value)
        elif request.kind == protocol.GET_PARAM:
            key = protocol.read_text(request.payload)
            reason = "" if key in controller.parameters else f"no parameter {key!r}"
        else:
            return self._refuse(request, protocol.UNSUPPORTED, f"{request.name} is unknown here")
        self._log_request(request, key)
        if reason:
            return self._refuse(request, protocol.BAD_LENGTH, reason)
        return protocol.PARAM, self._server.replies.parameter(request.sequence, key)

    def _handle_command(self, request: protocol.AsmRequest, received_ns: int) -> tuple[int, bytes]:
        controller, server = self._controller, self._server
        decoded = protocol.read_command(request.payload, controller.shell.n_act)
        if decoded is None:
            return self._refuse(request, protocol.BAD_LENGTH, f"{len(request.payload)} bytes of command")
        counter, mode, metres = decoded
        if not _is_later(counter, server.counter):
            return self._refuse(request, protocol.STALE, f"command {counter} after {server.counter}")
        server.counter = counter
        self._log_request(request, metres.copy())
        if not np.isfinite(metres).all():
            return self._refuse(request, protocol.NOT_FINITE, "a value is not finite")
        if controller.shell.state is ShellState.FAULT:
            return self._refuse(request, protocol.PANIC, controller.shell.fault, report_violation=False)
        if controller.shell.state is not ShellState.RUNNING:
            note = controller.note or f"it is {controller.shell.state}"
            return self._refuse(request, protocol.WRONG_STATE, note, report_violation=not controller.note)
        result, clipped = controller.command(metres, absolute=mode == _ABSOLUTE)
        return protocol.ACK, server.replies.ack(request.sequence, result, clipped, received_ns)

    def _log_request(self, request: protocol.AsmRequest, what: object) -> None:
        self._server.calls.append((request.name, what))

    def _refuse(
        self, request: protocol.AsmRequest, code: int, message: str, report_violation: bool = True
    ) -> tuple[int, bytes]:
        if report_violation:
            self._server.report_violation(f"{self.client}: {request.name} refused: {message}")
        return protocol.NAK, self._server.replies.nak(request.sequence, code, message)

    # ------------------------------------------------------------------ faults of the wire
    def _apply_connection_fault(self, fault: AsmFault) -> bool:
        """Play a fault that keeps a request from being looked at."""
        if self._transport is None or fault.kind not in ("close", "reset", "silent"):
            return False
        self.closed_by_server = fault.kind != "silent"
        if fault.kind == "close":
            self._transport.close()
        elif fault.kind == "reset":
            linger_option = struct.pack("ii", 1, 0)
            self._transport.get_extra_info("socket").setsockopt(
                socket.SOL_SOCKET, socket.SO_LINGER, linger_option
            )
            self.abort()
        else:
            self._is_muted = True
        return True

    def _send_reply(self, kind: int, payload: bytes, fault: AsmFault | None) -> None:
        """Send an answer, or what a fault makes of it."""
        data = self._encode_next_frame(kind, payload)
        fault_kind = "" if fault is None else fault.kind
        last, self._last_reply = self._last_reply, (kind, payload)
        if fault_kind == "delay" and fault is not None:
            asyncio.get_running_loop().call_later(fault.value, self._write, data)
        elif fault_kind == "half":
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
        self, controller: AsmController, serial: str, faults: dict[int, AsmFault], versions: tuple[int, int]
    ) -> None:
        self.controller, self.serial, self.versions = controller, serial, versions
        self.replies = ReplyWriter(controller, serial)
        self.calls: list[tuple[str, object]] = []
        self.complaints: list[str] = []
        self.damaged = self.requests = 0
        self.owner: AsmConnection | None = None
        #: Token of the last session and the last command's counter in it.
        self.token, self.counter = 0, 0
        self.connections: set[AsmConnection] = set()
        self._faults = faults
        self._server: asyncio.Server | None = None
        self._tick_task: asyncio.Task[None] | None = None

    # ------------------------------------------------------------------ listening
    async def listen(self, host: str, port: int) -> int:
        """Listen; returns the port.

        Raises
        ------
        OSError
            The address is taken or not ours.
        """
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

    def report_violation(self, message: str) -> None:
        """Write down what a client did wrong."""
        self.complaints.append(message)

    # ------------------------------------------------------------------ ownership
    def ownership_refusal(self, token: int) -> str:
        """Why a client with this token may not control the mirror; empty: it may."""
        if self.owner is None or token == self.token != 0:
            return ""
        return f"{self.owner.client} controls it"

    def set_owner(self, connection: AsmConnection, token: int) -> None:
        """Make a connection the owner; a dead one of the same session is cut off."""
        previous, self.owner = self.owner, connection
        if previous is not None and previous is not connection:
            previous.abort()
        if token != self.token:
            self.token, self.counter = token, 0

    def remove_connection(self, connection: AsmConnection) -> None:
        """A connection has ended."""
        self.connections.discard(connection)
        if self.owner is connection:
            self.owner = None
            if self.controller.shell.state is ShellState.RUNNING and not connection.closed_by_server:
                self.report_violation("the owner left the shell running")

    # ------------------------------------------------------------------ faults
    def next_fault(self) -> AsmFault | None:
        """What goes wrong at the owner's next request."""
        number, self.requests = self.requests, self.requests + 1
        return self._faults.get(number)

    def apply_mirror_fault(self, fault: AsmFault) -> None:
        """Have a fault of the mirror itself happen."""
        controller, actuator = self.controller, int(fault.value)
        if fault.kind == "skip":
            controller.pending_skips += 1
        elif fault.kind == "dust":
            controller.contaminated.add(actuator)
        elif fault.kind == "stuck":
            controller.shell.unreadable.add(actuator)
        elif fault.kind == "overcurrent":
            controller.shell.excess_a[actuator] = 1.2
        elif fault.kind == "calm":
            controller.shell.excess_a.clear()
            controller.shell.unreadable.clear()
        elif fault.kind == "watchdog":
            controller.rest_autonomously("the watchdog rested it, as arranged")
        elif fault.kind == "trip":
            controller.trip("panic, as arranged")
            self._broadcast_fault("panic, as arranged")

    # ------------------------------------------------------------------ by itself
    async def _tick(self) -> None:
        health_s = telemetry_s = last_frame_s = time.monotonic()
        while True:
            await asyncio.sleep(TICK_S)
            now = time.monotonic()
            if self.owner is not None:
                last_frame_s = self.owner.last_frame_s
            fault = self.controller.tick(now, now - last_frame_s)
            if fault:
                self._broadcast_fault(fault)
            if self.owner is not None and now - last_frame_s > self.controller.limits.rest_s:
                self.report_violation(
                    f"{self.owner.client} was silent for {self.controller.limits.rest_s:g} s"
                )
                self.owner.abort()
            if now - health_s >= 1.0:
                health_s = now
                self._send_to_observers(
                    protocol.HEALTH, self.replies.health(0, self.owner_name, self.damaged)
                )
            if now - telemetry_s >= 1 / self.controller.parameters["telemetry_hz"]:
                telemetry_s = now
                self._send_to_observers(protocol.TELEM, self.replies.telemetry())

    @property
    def owner_name(self) -> str:
        """Who controls the mirror; empty: nobody."""
        return "" if self.owner is None else self.owner.client

    def _broadcast_fault(self, fault: str) -> None:
        payload = self.replies.fault(fault)
        for connection in self.connections:
            connection.send_unsolicited(protocol.FAULT, payload)

    def _send_to_observers(self, kind: int, payload: bytes) -> None:
        for connection in self.connections:
            if connection.is_observer:
                connection.send_unsolicited(kind, payload)
