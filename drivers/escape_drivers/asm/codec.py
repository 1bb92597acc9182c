"""The wire of ESCAPE's own adaptive-secondary link, version 1: bytes in, messages out, no sockets.

The format is ours; ``docs/devices/asm-link.md`` defines it. All numbers are little-endian. A frame is
a header of 28 bytes with a checksum of its own, which protects the length, then the payload
and its checksum.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_drivers.asm import messages as m
from escape_hw.api.adaptive_secondary import STATE_ORDER, ShellState

MAGIC = b"ASM1"
#: Lowest and highest version spoken here.
VERSIONS = (1, 1)
MAX_PAYLOAD_BYTES = 65536

#: Magic, version, type, flags, sequence, payload length, sender's time; the checksum follows.
_HEADER = struct.Struct("<4sBBHIIQ")
_CRC = struct.Struct("<I")
HEADER_BYTES = _HEADER.size + _CRC.size

# Types of frames, requests below 64.
_HELLO, _COMMAND, _HEARTBEAT, _GET_HEALTH, _SET_STATE, _RECOVER, _SET_DISABLED, _GET, _SET = range(1, 10)
_WELCOME, _ACK, _NAK, _DONE, _HEALTH, _PARAM, _TELEM, _FAULT = range(64, 72)

#: States as numbers on the wire.
_STATES = (*STATE_ORDER, ShellState.FAULT)

_HELLO_FIELDS = struct.Struct("<BBBxQ")
_COMMAND_FIELDS = struct.Struct("<IBxxx")
_WELCOME_FIELDS = struct.Struct("<IBBBBHxxQffff")
_ACK_FIELDS = struct.Struct("<IHBBHxxQQ")
_NAK_FIELDS = struct.Struct("<IHBx")
_HEALTH_FIELDS = struct.Struct("<IBxxxQffffffIII")
_TELEM_FIELDS = struct.Struct("<IBxHQ")
_DONE_FIELDS, _PARAM_FIELDS = struct.Struct("<IB"), struct.Struct("<Id")
_HOLDING, _SIMULATED = 1, 1
#: A shape counted from the mirror's flat one, as all of ours are.
_RELATIVE_TO_FLAT = 1


class AsmCodec:
    """Our link, client's side. Holds what has arrived of a frame that is not whole yet."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._error = ""
        self._command_frame = bytearray()
        self._metres: NDArray[np.float32] = np.zeros(0, np.float32)
        #: Frames that were whole.
        self.frames = 0

    # ------------------------------------------------------------------ out
    def request(self, sequence: int, time_ns: int, message: m.Request) -> bytes:
        """The bytes of a request; raises ``ValueError`` if a text or a list is too long."""
        kind, payload = _encode_request(message)
        return encode_frame(kind, sequence, time_ns, payload)

    def command(self, sequence: int, time_ns: int, counter: int, metres: NDArray[np.float64]) -> bytearray:
        """The bytes of a shape ``(n_act,)``, metres from flat; the buffer is used again."""
        if self._metres.size != metres.size:
            size = HEADER_BYTES + _COMMAND_FIELDS.size + 4 * metres.size + _CRC.size
            self._command_frame = bytearray(size)
            self._metres = np.frombuffer(
                self._command_frame, "<f4", metres.size, HEADER_BYTES + _COMMAND_FIELDS.size
            )
        out, end = self._command_frame, len(self._command_frame) - _CRC.size
        _HEADER.pack_into(out, 0, MAGIC, VERSIONS[1], _COMMAND, 0, sequence, end - HEADER_BYTES, time_ns)
        view = memoryview(out)
        _CRC.pack_into(out, _HEADER.size, zlib.crc32(view[: _HEADER.size]))
        _COMMAND_FIELDS.pack_into(out, HEADER_BYTES, counter, _RELATIVE_TO_FLAT)
        self._metres[:] = metres
        _CRC.pack_into(out, end, zlib.crc32(view[HEADER_BYTES:end]))
        return out

    # ------------------------------------------------------------------ in
    def feed(self, data: bytes | bytearray | memoryview) -> list[m.Reply]:
        """Whole replies among what has arrived so far, in order.

        Raises
        ------
        ProtocolError
            Not this protocol, or damaged; raised again at every further call.
        """
        if self._error:
            raise m.ProtocolError(self._error)
        self._buffer += data
        replies: list[m.Reply] = []
        try:
            while (parsed := _parse_frame(self._buffer)) is not None:
                kind, payload, used = parsed
                replies.append(_decode_reply(kind, payload))
                del self._buffer[:used]
                self.frames += 1
        except (struct.error, ValueError, IndexError) as error:
            self._error = f"a reply makes no sense: {error}"
            raise m.ProtocolError(self._error) from error
        except m.ProtocolError as error:
            self._error = str(error)
            raise
        return replies


def encode_frame(kind: int, sequence: int, time_ns: int, payload: bytes) -> bytes:
    """A frame around a payload; raises ``ValueError`` if it is larger than the protocol allows."""
    if len(payload) > MAX_PAYLOAD_BYTES:
        raise ValueError(f"{len(payload)} bytes are more than the {MAX_PAYLOAD_BYTES} that a frame may have")
    head = _HEADER.pack(MAGIC, VERSIONS[1], kind, 0, sequence, len(payload), time_ns)
    return b"".join((head, _CRC.pack(zlib.crc32(head)), payload, _CRC.pack(zlib.crc32(payload))))


def _parse_frame(buffer: bytearray) -> tuple[int, bytes, int] | None:
    """Type, payload and size of the first frame if it is whole; ``ProtocolError`` at the first wrong byte."""
    if not MAGIC.startswith(buffer[: len(MAGIC)]):
        raise m.ProtocolError(f"a frame begins with {bytes(buffer[:4])!r}, not {MAGIC!r}")
    if len(buffer) < HEADER_BYTES:
        return None
    _, version, kind, _, _, length, _ = _HEADER.unpack_from(buffer)
    (expected_crc,) = _CRC.unpack_from(buffer, _HEADER.size)
    if zlib.crc32(buffer[: _HEADER.size]) != expected_crc:
        raise m.ProtocolError("the checksum of a header is wrong")
    if not VERSIONS[0] <= version <= VERSIONS[1]:
        raise m.ProtocolError(
            f"the peer speaks version {version}, this driver {VERSIONS[0]} to {VERSIONS[1]}"
        )
    if length > MAX_PAYLOAD_BYTES:
        raise m.ProtocolError(f"a frame announces {length} bytes; at most {MAX_PAYLOAD_BYTES} are allowed")
    end = HEADER_BYTES + length
    if len(buffer) < end + _CRC.size:
        return None
    payload = bytes(buffer[HEADER_BYTES:end])
    (expected_crc,) = _CRC.unpack_from(buffer, end)
    if zlib.crc32(payload) != expected_crc:
        raise m.ProtocolError("the checksum of a payload is wrong")
    return kind, payload, end + _CRC.size


# --------------------------------------------------------------------- requests
def _encode_request(message: m.Request) -> tuple[int, bytes]:
    """Type and payload of a request."""
    match message:
        case m.Hello(role, token, name):
            return _HELLO, _HELLO_FIELDS.pack(*VERSIONS, role, token) + _encode_text(name)
        case m.Heartbeat():
            return _HEARTBEAT, b""
        case m.GetHealth():
            return _GET_HEALTH, b""
        case m.SetState(state):
            return _SET_STATE, bytes([_STATES.index(state)])
        case m.Recover():
            return _RECOVER, b""
        case m.SetDisabled(actuators, reason):
            return _SET_DISABLED, _encode_bitmap(actuators) + _encode_text(reason)
        case m.GetParam(key):
            return _GET, _encode_text(key)
        case m.SetParam(key, value):
            return _SET, struct.pack("<d", value) + _encode_text(key)


def _encode_text(text: str) -> bytes:
    encoded = text.encode()
    if len(encoded) > 0xFFFF:
        raise ValueError(f"a text of {len(encoded)} bytes is longer than 65535")
    return struct.pack("<H", len(encoded)) + encoded


def _encode_bitmap(actuators: Iterable[int]) -> bytes:
    """Length and bits, the lowest bit of the first byte for actuator 0."""
    indices = list(actuators)
    flags = np.zeros(max(indices, default=-1) + 1, np.uint8)
    flags[indices] = 1
    packed = np.packbits(flags, bitorder="little").tobytes()
    return struct.pack("<H", len(packed)) + packed


# --------------------------------------------------------------------- replies
class _PayloadReader:
    """Reads a payload from front to back."""

    def __init__(self, payload: bytes) -> None:
        self.payload, self.offset = payload, 0

    def read_bytes(self, count: int) -> bytes:
        if self.offset + count > len(self.payload):
            raise ValueError(f"{len(self.payload)} bytes of payload are too few")
        self.offset += count
        return self.payload[self.offset - count : self.offset]

    def unpack(self, fields: struct.Struct) -> tuple[Any, ...]:
        return fields.unpack(self.read_bytes(fields.size))

    def read_counted(self) -> bytes:
        (count,) = struct.unpack("<H", self.read_bytes(2))
        return self.read_bytes(count)

    def text(self) -> str:
        return self.read_counted().decode()

    def indices(self) -> tuple[int, ...]:
        bits = np.unpackbits(np.frombuffer(self.read_counted(), np.uint8), bitorder="little")
        return tuple(int(i) for i in np.flatnonzero(bits))

    def read_floats(self, count: int) -> NDArray[np.float32]:
        return np.frombuffer(self.read_bytes(4 * count), "<f4")

    def end(self) -> None:
        if self.offset != len(self.payload):
            raise ValueError(f"{len(self.payload) - self.offset} bytes of payload are too many")


def _decode_reply(kind: int, payload: bytes) -> m.Reply:
    """The reply in a payload."""
    read = _PayloadReader(payload)
    reply = _read_reply(kind, read)
    read.end()
    return reply


def _read_reply(kind: int, read: _PayloadReader) -> m.Reply:
    if kind == _WELCOME:
        echo, version, _, state, flags, n_act, token, command, step, hold, rest = read.unpack(_WELCOME_FIELDS)
        return m.Welcome(
            echo, version, token, read.text(), bool(flags & _SIMULATED), _STATES[state], command, step, hold,
            rest, read.indices(), read.read_floats(n_act),
        )  # fmt: skip
    if kind == _ACK:
        echo, result, state, flags, clipped, received, applied = read.unpack(_ACK_FIELDS)
        positions = read.read_floats((len(read.payload) - read.offset) // 4)
        holding = bool(flags & _HOLDING)
        return m.Ack(echo, m.Result(result), _STATES[state], clipped, holding, received, applied, positions)
    if kind == _NAK:
        echo, code, state = read.unpack(_NAK_FIELDS)
        return m.Nak(echo, m.Result(code), _STATES[state], read.text())
    if kind == _DONE:
        echo, state = read.unpack(_DONE_FIELDS)
        return m.Done(echo, _STATES[state], read.text())
    if kind == _HEALTH:
        (
            echo, state, time_ns, gap, current, warmest, coolant, humidity, dew, applied, skipped, crc_errors,
        ) = read.unpack(_HEALTH_FIELDS)  # fmt: skip
        return m.HealthReport(
            echo, _STATES[state], time_ns, gap, current, warmest, coolant, humidity, dew, applied, skipped,
            crc_errors, read.indices(), read.text(), read.text(),
        )  # fmt: skip
    if kind == _PARAM:
        echo, value = read.unpack(_PARAM_FIELDS)
        return m.Param(echo, read.text(), value)
    if kind == _TELEM:
        counter, state, n_act, time_ns = read.unpack(_TELEM_FIELDS)
        command, position, current = (read.read_floats(n_act) for _ in range(3))
        flag_bytes = np.frombuffer(read.read_bytes(n_act), np.uint8)
        return m.TelemetrySample(counter, _STATES[state], time_ns, command, position, current, flag_bytes)
    if kind == _FAULT:
        (state,) = read.read_bytes(1)
        return m.FaultReport(_STATES[state], read.text())
    raise ValueError(f"type {kind} is unknown")
