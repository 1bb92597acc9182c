"""The wire of ESCAPE's own adaptive-secondary link, version 1: bytes in, messages out, no sockets.

The format is ours; ``docs/devices/asm-link.md`` defines it. All numbers are little-endian. A frame is
a header of 28 bytes with a checksum of its own, so that the length can be trusted, then the payload
and its checksum.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import NDArray

from escape_drivers import asm_messages as m
from escape_hw.api.adaptive_secondary import LADDER, ShellState

MAGIC = b"ASM1"
#: Lowest and highest version spoken here.
VERSIONS = (1, 1)
LARGEST_PAYLOAD = 65536

#: Magic, version, type, flags, sequence, payload length, sender's time; the checksum follows.
_HEAD = struct.Struct("<4sBBHIIQ")
_CRC = struct.Struct("<I")
HEADER_BYTES = _HEAD.size + _CRC.size

# Types of frames, requests below 64.
_HELLO, _COMMAND, _HEARTBEAT, _GET_HEALTH, _SET_STATE, _RECOVER, _SET_DISABLED, _GET, _SET = range(1, 10)
_WELCOME, _ACK, _NAK, _DONE, _HEALTH, _PARAM, _TELEM, _FAULT = range(64, 72)

#: States as numbers on the wire.
_STATES = (*LADDER, ShellState.FAULT)

_HELLO_FIELDS = struct.Struct("<BBBxQ")
_COMMAND_FIELDS = struct.Struct("<IBxxx")
_WELCOME_FIELDS = struct.Struct("<IBBBBHxxQffff")
_ACK_FIELDS = struct.Struct("<IHBBHxxQQ")
_NAK_FIELDS = struct.Struct("<IHBx")
_HEALTH_FIELDS = struct.Struct("<IBxxxQffffffIII")
_TELEM_FIELDS = struct.Struct("<IBxHQ")
_HOLDING, _SIMULATED = 1, 1
#: A shape counted from the mirror's flat one, as all of ours are.
_FROM_FLAT = 1


class AsmCodec:
    """Our link, client's side. Holds what has arrived of a frame that is not whole yet."""

    def __init__(self) -> None:
        self._arrived = bytearray()
        self._broken = ""
        self._frame = bytearray()
        self._metres: NDArray[np.float32] = np.zeros(0, np.float32)
        #: Frames that were whole.
        self.frames = 0

    # ------------------------------------------------------------------ out
    def request(self, sequence: int, time_ns: int, message: m.Request) -> bytes:
        """The bytes of a request.

        Raises
        ------
        ValueError
            It does not fit: a text or a list that is too long.
        """
        kind, payload = _packed(message)
        return frame(kind, sequence, time_ns, payload)

    def command(self, sequence: int, time_ns: int, counter: int, metres: NDArray[np.float64]) -> bytearray:
        """The bytes of a shape ``(n_act,)``, metres from flat; the buffer is used again."""
        if self._metres.size != metres.size:
            size = HEADER_BYTES + _COMMAND_FIELDS.size + 4 * metres.size + _CRC.size
            self._frame = bytearray(size)
            self._metres = np.frombuffer(self._frame, "<f4", metres.size, HEADER_BYTES + _COMMAND_FIELDS.size)
        out, end = self._frame, len(self._frame) - _CRC.size
        _HEAD.pack_into(out, 0, MAGIC, VERSIONS[1], _COMMAND, 0, sequence, end - HEADER_BYTES, time_ns)
        view = memoryview(out)
        _CRC.pack_into(out, _HEAD.size, zlib.crc32(view[: _HEAD.size]))
        _COMMAND_FIELDS.pack_into(out, HEADER_BYTES, counter, _FROM_FLAT)
        self._metres[:] = metres
        _CRC.pack_into(out, end, zlib.crc32(view[HEADER_BYTES:end]))
        return out

    # ------------------------------------------------------------------ in
    def feed(self, data: bytes | bytearray | memoryview) -> list[m.Reply]:
        """Whole replies among what has arrived so far, in order.

        Raises
        ------
        ProtocolError
            Not this protocol, or damaged; said again at every further call.
        """
        if self._broken:
            raise m.ProtocolError(self._broken)
        self._arrived += data
        replies: list[m.Reply] = []
        try:
            while (found := _whole(self._arrived)) is not None:
                kind, payload, used = found
                replies.append(_unpacked(kind, payload))
                del self._arrived[:used]
                self.frames += 1
        except (struct.error, ValueError, IndexError) as error:
            self._broken = f"a reply makes no sense: {error}"
            raise m.ProtocolError(self._broken) from error
        except m.ProtocolError as error:
            self._broken = str(error)
            raise
        return replies


def frame(kind: int, sequence: int, time_ns: int, payload: bytes) -> bytes:
    """A frame around a payload.

    Raises
    ------
    ValueError
        The payload is larger than the protocol allows.
    """
    if len(payload) > LARGEST_PAYLOAD:
        raise ValueError(f"{len(payload)} bytes are more than the {LARGEST_PAYLOAD} that a frame may have")
    head = _HEAD.pack(MAGIC, VERSIONS[1], kind, 0, sequence, len(payload), time_ns)
    return b"".join((head, _CRC.pack(zlib.crc32(head)), payload, _CRC.pack(zlib.crc32(payload))))


def _whole(arrived: bytearray) -> tuple[int, bytes, int] | None:
    """Type, payload and size of the first frame if it is whole.

    Raises
    ------
    ProtocolError
        What has arrived cannot become a frame; told at the first byte that shows it.
    """
    if not MAGIC.startswith(arrived[: len(MAGIC)]):
        raise m.ProtocolError(f"a frame begins with {bytes(arrived[:4])!r}, not {MAGIC!r}")
    if len(arrived) < HEADER_BYTES:
        return None
    _, version, kind, _, _, length, _ = _HEAD.unpack_from(arrived)
    (told,) = _CRC.unpack_from(arrived, _HEAD.size)
    if zlib.crc32(arrived[: _HEAD.size]) != told:
        raise m.ProtocolError("the checksum of a header is wrong")
    if not VERSIONS[0] <= version <= VERSIONS[1]:
        raise m.ProtocolError(
            f"the peer speaks version {version}, this driver {VERSIONS[0]} to {VERSIONS[1]}"
        )
    if length > LARGEST_PAYLOAD:
        raise m.ProtocolError(f"a frame announces {length} bytes; at most {LARGEST_PAYLOAD} are allowed")
    end = HEADER_BYTES + length
    if len(arrived) < end + _CRC.size:
        return None
    payload = bytes(arrived[HEADER_BYTES:end])
    (told,) = _CRC.unpack_from(arrived, end)
    if zlib.crc32(payload) != told:
        raise m.ProtocolError("the checksum of a payload is wrong")
    return kind, payload, end + _CRC.size


# --------------------------------------------------------------------- requests
def _packed(message: m.Request) -> tuple[int, bytes]:
    """Type and payload of a request."""
    match message:
        case m.Hello(role, token, name):
            return _HELLO, _HELLO_FIELDS.pack(*VERSIONS, role, token) + _text(name)
        case m.Heartbeat():
            return _HEARTBEAT, b""
        case m.GetHealth():
            return _GET_HEALTH, b""
        case m.SetState(state):
            return _SET_STATE, bytes([_STATES.index(state)])
        case m.Recover():
            return _RECOVER, b""
        case m.SetDisabled(actuators, reason):
            return _SET_DISABLED, _bitmap(actuators) + _text(reason)
        case m.GetParam(key):
            return _GET, _text(key)
        case m.SetParam(key, value):
            return _SET, struct.pack("<d", value) + _text(key)


def _text(text: str) -> bytes:
    encoded = text.encode()
    if len(encoded) > 0xFFFF:
        raise ValueError(f"a text of {len(encoded)} bytes is longer than 65535")
    return struct.pack("<H", len(encoded)) + encoded


def _bitmap(actuators: Iterable[int]) -> bytes:
    """Length and bits, the lowest bit of the first byte for actuator 0."""
    numbers = list(actuators)
    flags = np.zeros(max(numbers, default=-1) + 1, np.uint8)
    flags[numbers] = 1
    packed = np.packbits(flags, bitorder="little").tobytes()
    return struct.pack("<H", len(packed)) + packed


# --------------------------------------------------------------------- replies
class _Cursor:
    """Reads a payload from front to back."""

    def __init__(self, payload: bytes) -> None:
        self.payload, self.at = payload, 0

    def take(self, count: int) -> bytes:
        if self.at + count > len(self.payload):
            raise ValueError(f"{len(self.payload)} bytes of payload are too few")
        self.at += count
        return self.payload[self.at - count : self.at]

    def counted(self) -> bytes:
        (count,) = struct.unpack("<H", self.take(2))
        return self.take(count)

    def text(self) -> str:
        return self.counted().decode()

    def numbers(self) -> tuple[int, ...]:
        bits = np.unpackbits(np.frombuffer(self.counted(), np.uint8), bitorder="little")
        return tuple(int(i) for i in np.flatnonzero(bits))

    def floats(self, count: int) -> NDArray[np.float32]:
        return np.frombuffer(self.take(4 * count), "<f4")

    def end(self) -> None:
        if self.at != len(self.payload):
            raise ValueError(f"{len(self.payload) - self.at} bytes of payload are too many")


def _welcome(read: _Cursor) -> m.Welcome:
    echo, version, _, state, flags, n_act, token, command, step, hold, rest = _WELCOME_FIELDS.unpack(
        read.take(_WELCOME_FIELDS.size)
    )
    serial, disabled, present = read.text(), read.numbers(), read.floats(n_act)
    return m.Welcome(
        echo, version, token, serial, bool(flags & _SIMULATED), _STATES[state], command, step, hold, rest,
        disabled, present,
    )  # fmt: skip


def _ack(read: _Cursor) -> m.Ack:
    echo, result, state, flags, clipped, received, applied = _ACK_FIELDS.unpack(read.take(_ACK_FIELDS.size))
    count = (len(read.payload) - read.at) // 4
    return m.Ack(
        echo, m.Result(result), _STATES[state], clipped, bool(flags & _HOLDING), received, applied,
        read.floats(count),
    )  # fmt: skip


def _nak(read: _Cursor) -> m.Nak:
    echo, code, state = _NAK_FIELDS.unpack(read.take(_NAK_FIELDS.size))
    return m.Nak(echo, m.Result(code), _STATES[state], read.text())


def _done(read: _Cursor) -> m.Done:
    echo, state = struct.unpack("<IB", read.take(5))
    return m.Done(echo, _STATES[state], read.text())


def _health(read: _Cursor) -> m.Health:
    echo, state, time_ns, gap, current, warmest, coolant, humidity, dew, applied, skipped, bad = (
        _HEALTH_FIELDS.unpack(read.take(_HEALTH_FIELDS.size))
    )
    contaminated, owner, fault = read.numbers(), read.text(), read.text()
    return m.Health(
        echo, _STATES[state], time_ns, gap, current, warmest, coolant, humidity, dew, applied, skipped, bad,
        contaminated, owner, fault,
    )  # fmt: skip


def _param(read: _Cursor) -> m.Param:
    echo, value = struct.unpack("<Id", read.take(12))
    return m.Param(echo, read.text(), value)


def _telemetry(read: _Cursor) -> m.Telemetry:
    counter, state, n_act, time_ns = _TELEM_FIELDS.unpack(read.take(_TELEM_FIELDS.size))
    command, position, current = (read.floats(n_act) for _ in range(3))
    flags = np.frombuffer(read.take(n_act), np.uint8)
    return m.Telemetry(counter, _STATES[state], time_ns, command, position, current, flags)


def _fault(read: _Cursor) -> m.Fault:
    (state,) = read.take(1)
    return m.Fault(_STATES[state], read.text())


_READERS: dict[int, Callable[[_Cursor], m.Reply]] = {
    _WELCOME: _welcome,
    _ACK: _ack,
    _NAK: _nak,
    _DONE: _done,
    _HEALTH: _health,
    _PARAM: _param,
    _TELEM: _telemetry,
    _FAULT: _fault,
}


def _unpacked(kind: int, payload: bytes) -> m.Reply:
    """The reply in a payload."""
    reader = _READERS.get(kind)
    if reader is None:
        raise ValueError(f"type {kind} is unknown")
    cursor = _Cursor(payload)
    reply = reader(cursor)
    cursor.end()
    return reply
