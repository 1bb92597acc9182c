"""The adaptive-secondary link as the mirror's side decodes and encodes it.

Written from ``docs/devices/asm-link.md`` only: driver and emulator share no code, so that errors in one
of them show in the other.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

HELLO, COMMAND, HEARTBEAT, GET_HEALTH, SET_STATE, RECOVER, SET_DISABLED, GET_PARAM, SET_PARAM = range(1, 10)
WELCOME, ACK, NAK, DONE, HEALTH, PARAM, TELEM, FAULT = range(64, 72)
NAMES = {
    HELLO: "HELLO", COMMAND: "COMMAND", HEARTBEAT: "HEARTBEAT", GET_HEALTH: "GET_HEALTH",
    SET_STATE: "SET_STATE", RECOVER: "RECOVER", SET_DISABLED: "SET_DISABLED", GET_PARAM: "GET_PARAM",
    SET_PARAM: "SET_PARAM",
}  # fmt: skip
(
    APPLIED, CLIPPED, SKIPPED, STALE, WRONG_STATE, BAD_LENGTH, NOT_OWNER, NOT_FINITE, PANIC, UNSUPPORTED,
) = range(10)  # fmt: skip

VERSION = 1
HEADER_BYTES = 28
MAX_PAYLOAD_BYTES = 64 * 1024


class DamagedFrame(Exception):
    """The received bytes are not a frame; the connection ends."""


@dataclass(frozen=True, slots=True)
class AsmRequest:
    """A complete frame from a client."""

    kind: int
    version: int
    sequence: int
    sent_ns: int
    payload: bytes

    @property
    def name(self) -> str:
        """Name of its type."""
        return NAMES.get(self.kind, f"type {self.kind}")


def decode_frame(buffer: bytearray) -> AsmRequest | None:
    """Remove the first frame from the buffer; None if it is not complete.

    Raises
    ------
    DamagedFrame
        The buffer does not begin with a valid frame.
    """
    start = bytes(buffer[:4])
    if start != b"ASM1"[: len(start)]:
        raise DamagedFrame(f"no frame begins with {start!r}")
    if len(buffer) < HEADER_BYTES:
        return None
    version, kind, _flags, sequence, length, sent_ns, crc = struct.unpack("<BBHIIQI", buffer[4:HEADER_BYTES])
    if crc != zlib.crc32(buffer[: HEADER_BYTES - 4]):
        raise DamagedFrame("header checksum")
    if length > MAX_PAYLOAD_BYTES:
        raise DamagedFrame(f"payload of {length} bytes")
    frame_bytes = HEADER_BYTES + length + 4
    if len(buffer) < frame_bytes:
        return None
    payload = bytes(buffer[HEADER_BYTES : HEADER_BYTES + length])
    if struct.unpack("<I", buffer[HEADER_BYTES + length : frame_bytes])[0] != zlib.crc32(payload):
        raise DamagedFrame("payload checksum")
    del buffer[:frame_bytes]
    return AsmRequest(kind, version, sequence, sent_ns, payload)


def encode_frame(kind: int, sequence: int, now_ns: int, payload: bytes) -> bytes:
    """Encode a frame to a client."""
    head = b"ASM1" + struct.pack("<BBHIIQ", VERSION, kind, 0, sequence & 0xFFFFFFFF, len(payload), now_ns)
    return head + zlib.crc32(head).to_bytes(4, "little") + payload + zlib.crc32(payload).to_bytes(4, "little")


def read_hello(payload: bytes) -> tuple[int, int, int, int, str]:
    """Lowest and highest version, role, token and name of the client."""
    low, high, role, _, token = struct.unpack("<BBBBQ", payload[:12])
    return low, high, role, token, read_text(payload[12:])


def read_command(payload: bytes, n_act: int) -> tuple[int, int, NDArray[np.float32]] | None:
    """Counter, mode and shape ``(n_act,)`` in metres; None if the length is wrong."""
    if len(payload) != 8 + 4 * n_act:
        return None
    counter, mode = struct.unpack("<IB", payload[:5])
    return counter, mode, np.frombuffer(payload, dtype="<f4", offset=8)


def read_disabled(payload: bytes) -> tuple[set[int], str]:
    """Disabled actuators, and the reason."""
    size = int.from_bytes(payload[:2], "little")
    bits = payload[2 : 2 + size]
    if len(bits) != size:
        raise ValueError("truncated bitmap")
    numbers = {8 * i + k for i, byte in enumerate(bits) for k in range(8) if byte >> k & 1}
    return numbers, read_text(payload[2 + size :])


def read_text(payload: bytes) -> str:
    """Text with its length in front, which ends the payload."""
    size = int.from_bytes(payload[:2], "little")
    if len(payload) != 2 + size:
        raise ValueError("text of the wrong length")
    return payload[2:].decode()


def encode_text(string: str) -> bytes:
    """Text with its length in front."""
    data = string.encode()[:65535]
    return len(data).to_bytes(2, "little") + data


def encode_bitmap(numbers: Iterable[int], n_act: int) -> bytes:
    """Bitmap over all actuators with its length in front."""
    data = bytearray((n_act + 7) // 8)
    for number in numbers:
        data[number // 8] |= 1 << number % 8
    return len(data).to_bytes(2, "little") + bytes(data)


def encode_floats(values: NDArray[np.floating]) -> bytes:
    """Numbers in single precision."""
    return np.asarray(values, dtype="<f4").tobytes()
