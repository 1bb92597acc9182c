"""Cost of a command to an adaptive secondary, beside a bare socket's."""

from __future__ import annotations

import contextlib
import re
import socket
import subprocess
import sys
import time
import zlib
from collections.abc import Iterator

import numpy as np

from escape_benchmarks.rows import time_row
from escape_drivers.asm import messages as m
from escape_drivers.asm.codec import HEADER_BYTES, AsmCodec
from escape_drivers.asm.mirror import AsmMirror
from escape_hw.api.adaptive_secondary import STATE_ORDER
from escape_hw.api.benchmark import BenchmarkRow, time_alternately
from escape_hw.config.devices import MirrorConfig
from escape_hw.config.loader import load_system
from escape_hw.errors import DeviceError

#: Commands that the bare socket has ready.
_READY = 6000
_ESCAPE = [sys.executable, "-c", "from escape_hw.cli import main; main()"]


def run() -> list[BenchmarkRow]:
    """Entry point ``asm`` of ``escape.benchmarks``."""
    section = load_system("maps-nir").devices.dm
    with _emulator() as ours, _emulator() as theirs:
        mirror = AsmMirror(
            section.serial, layout=section.layout, stroke_m=section.stroke_m,
            limits=section.limits.to_limits(), port=ours, heartbeat_s=60.0,
        )  # fmt: skip
        with mirror, contextlib.closing(_BareSocketClient(theirs, section.n_act)) as bare_client:
            legal = np.full(section.n_act, 0.001)
            legal[list(section.limits.disabled)] = 0.0
            shapes = [legal, -legal]
            turn = iter(range(1 << 62))
            times = time_alternately(
                lambda: mirror.send(shapes[next(turn) % 2]), bare_client.command, seconds=0.3
            )
    peer = "bare socket to the same emulator, frames made beforehand"
    note = "336 actuators over loopback, emulator in a process of its own"
    return [time_row("asm: command and acknowledgement", times, peer, "us", note), _codec_row(section)]


def _codec_row(section: MirrorConfig) -> BenchmarkRow:
    """Making a command and reading an answer, beside the conversion and the checksums alone."""
    codec, metres = AsmCodec(), np.linspace(-1e-6, 1e-6, section.n_act)
    answer = bytes(AsmCodec().command(1, 1, 1, metres))
    payload = bytes(answer[HEADER_BYTES:])

    def ours() -> None:
        codec.command(1, 1, 1, metres)

    def lower_bound() -> None:
        zlib.crc32(metres.astype("<f4").tobytes())
        zlib.crc32(payload[:24])

    times = time_alternately(ours, lower_bound, seconds=0.2)
    return time_row("asm: frame of a command", times, "numpy conversion and zlib's checksums alone", "us")


@contextlib.contextmanager
def _emulator() -> Iterator[int]:
    """An emulator in a process of its own; gives its port."""
    options = ["transition_speed=1000", "hold_s=30", "rest_s=60"]
    words = [*_ESCAPE, "emulate", "asm", "--port", "0", *(f"--option={option}" for option in options)]
    process = subprocess.Popen(words, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
    try:
        first_line = process.stderr.readline() if process.stderr is not None else ""
        found = re.search(r":(\d+)\s*$", first_line)
        if found is None:
            raise DeviceError("asm", f"the emulator did not start: {first_line.strip() or 'no output'}")
        yield int(found[1])
    finally:
        process.kill()
        process.communicate()


class _BareSocketClient:
    """A client that has every message ready and discards replies."""

    def __init__(self, port: int, n_act: int) -> None:
        self._codec, self._sequence = AsmCodec(), 0
        self._socket = socket.create_connection(("127.0.0.1", port), 10.0)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._ask(m.Hello(m.Role.CONTROL, 0, "bare"))
        for state in STATE_ORDER[1:]:
            self._ask(m.SetState(state))
            # A step of the quick emulator is over by then.
            time.sleep(0.1)
            self._ask(m.Heartbeat())
        self._size = self._ask(m.Heartbeat())
        start, now = self._sequence, time.monotonic_ns()
        metres = np.zeros(n_act)
        made = (bytes(self._codec.command(start + k, now, k, metres)) for k in range(1, _READY + 1))
        self._frames = iter(list(made))

    def close(self) -> None:
        """Disconnect."""
        self._socket.close()

    def _ask(self, message: m.Request) -> int:
        self._sequence += 1
        self._socket.sendall(self._codec.request(self._sequence, time.monotonic_ns(), message))
        time.sleep(0.02)
        return len(self._socket.recv(65536))

    def command(self) -> None:
        """Send the next frame and wait for as many bytes as an acknowledgement has."""
        self._socket.sendall(next(self._frames))
        left = self._size
        while left > 0:
            left -= len(self._socket.recv(left))
