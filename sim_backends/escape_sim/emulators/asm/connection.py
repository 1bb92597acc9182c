"""Connections of the emulated adaptive secondary: framing, unsolicited messages, faults of the link."""

from __future__ import annotations

import asyncio
import socket
import struct
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, cast

from escape_hw.errors import ConfigError
from escape_sim.emulators.asm import protocol
from escape_sim.emulators.options import current_word

if TYPE_CHECKING:
    from escape_sim.emulators.asm.server import AsmServer

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
