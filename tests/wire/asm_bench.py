"""An emulated adaptive secondary and its driver, and misbehaving clients."""

from __future__ import annotations

import socket
import struct
import time
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

import pytest

from escape_drivers.asm.mirror import AsmMirror
from escape_hw.api.emulator import EmulatorRequest
from escape_hw.config.loader import load_system
from escape_hw.config.registry import DeviceContext
from escape_hw.config.system import SystemConfig
from escape_sim.emulators.asm import protocol as asm_wire
from escape_sim.emulators.asm.emulator import AsmEmulator, make_emulator

#: Longest wait for something that takes milliseconds on an idle machine, seconds.
PATIENCE_S = 30.0


@contextmanager
def emulator(**options: object) -> Iterator[AsmEmulator]:
    """An emulator on a free port; by default with fast transitions and a long watchdog time-out."""
    chosen = {"transition_speed": 1000, "hold_s": 20, "rest_s": 60, **options}
    made = make_emulator(EmulatorRequest(port=0, options={k: str(v) for k, v in chosen.items()}))
    assert isinstance(made, AsmEmulator)
    with made:
        yield made


def driver(port: int, *more: str, **options: Any) -> AsmMirror:
    """A mirror, not open, on the emulator's port; the options are those of its section."""
    chosen = {"port": port, "reply_s": 10.0, "heartbeat_s": 600.0, **options}
    return as_driver(_config(tuple(sorted(chosen.items())), more))


def as_driver(config: SystemConfig) -> AsmMirror:
    """The mirror of a system, not open."""
    return AsmMirror.from_section(config.devices.dm, DeviceContext("dm", config))


@cache
def _config(options: tuple[tuple[str, Any], ...], more: tuple[str, ...]) -> Any:
    words = [f"devices.dm.options.{key}={str(value).lower()}" for key, value in options]
    return load_system("maps-nir", overrides=["devices.dm.mode=hardware", *words, *more])


def port_of(made: AsmEmulator) -> int:
    return int(made.start().rpartition(":")[2])


def wait_for(what: Callable[[], bool], why: str) -> None:
    """Wait until something is so; fail after a long while."""
    deadline = time.monotonic() + PATIENCE_S
    while not what():
        if time.monotonic() > deadline:
            pytest.fail(f"never happened: {why}")
        time.sleep(0.005)


def frame(kind: int, sequence: int, payload: bytes = b"", *, sent_ns: int | None = None) -> bytes:
    """A frame as ``docs/devices/asm-link.md`` describes it, written by hand once more."""
    sent = time.monotonic_ns() if sent_ns is None else sent_ns
    head = struct.pack("<4sBBHIIQ", b"ASM1", 1, kind, 0, sequence, len(payload), sent)
    return head + struct.pack("<I", zlib.crc32(head)) + payload + struct.pack("<I", zlib.crc32(payload))


def hello(sequence: int = 1, role: int = 0, token: int = 0, versions: tuple[int, int] = (1, 1)) -> bytes:
    payload = struct.pack("<BBBBQ", *versions, role, 0, token) + struct.pack("<H", 4) + b"test"
    return frame(asm_wire.HELLO, sequence, payload)


def command(sequence: int, counter: int, value: float = 0.0, n_act: int = 336) -> bytes:
    payload = struct.pack("<IBxxx", counter, 1) + struct.pack(f"<{n_act}f", *([value] * n_act))
    return frame(asm_wire.COMMAND, sequence, payload)


class RawClient:
    """A socket and nothing else."""

    def __init__(self, port: int) -> None:
        self.socket = socket.create_connection(("127.0.0.1", port), PATIENCE_S)
        self.socket.settimeout(PATIENCE_S)
        self._arrived = bytearray()

    def __enter__(self) -> RawClient:
        return self

    def __exit__(self, *error: object) -> None:
        self.socket.close()

    def send(self, data: bytes) -> None:
        self.socket.sendall(data)

    def reply(self, kind: int) -> bytes:
        """Payload of the next frame of a type; others are passed over."""
        while True:
            while (found := asm_wire.decode_frame(self._arrived)) is None:
                data = self.socket.recv(65536)
                assert data, "the emulator closed the connection"
                self._arrived += data
            if found.kind == kind:
                return found.payload

    def hung_up(self) -> bool:
        """Wait for the end of the connection."""
        try:
            while self.socket.recv(65536):
                pass
        except ConnectionError:
            pass
        return True
