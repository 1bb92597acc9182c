"""What the E-727's driver costs on top of the wire: against a bare socket, and against PI's own client."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import socket
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from typing import Any

from escape_benchmarks.rows import time_row
from escape_drivers.pi.controller import E727
from escape_drivers.pi.link import GcsLink
from escape_drivers.pi.transports import TcpTransport
from escape_hw.api.benchmark import BenchmarkRow, time_alternately
from escape_hw.api.emulator import EmulatorRequest
from escape_hw.config.registry import emulator_factory

_QUERY, _COMMAND = b"POS? 1 2\n", b"VEL 1 1000\nERR?\n"
_ABSENT = "PIPython is not installed (its licence allows use with PI's products only)"


def run() -> list[BenchmarkRow]:
    """All rows of the stage."""
    with ExitStack() as stack:
        addresses = [_emulator(stack) for _ in range(3)]
        link = GcsLink("stage", TcpTransport(*addresses[0], 3.0, 1.0), 1.0)
        link.open()
        stack.callback(link.close)
        bare = stack.enter_context(socket.create_connection(addresses[1]))
        bare.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        controller = E727(link, ("1", "2"))
        theirs = _client(*addresses[2])
        query, send_command = controller.positions, partial(link.send_command, "VEL", "1", 1000)
        ask_bare, tell_bare = partial(_exchange, bare, _QUERY), partial(_exchange, bare, _COMMAND)
        ask_theirs = None if theirs is None else partial(theirs.qPOS, ["1", "2"])
        tell_theirs = None if theirs is None else partial(theirs.VEL, "1", 1000)
        return [
            _row("position of both axes", query, ask_bare, "bare socket"),
            _row("confirmed command", send_command, tell_bare, "bare socket"),
            _row("position of both axes", query, ask_theirs, _pipython_name()),
            _row("confirmed command", send_command, tell_theirs, _pipython_name()),
        ]


def _emulator(stack: ExitStack) -> tuple[str, int]:
    """An emulated controller of its own, and where it listens."""
    emulator = emulator_factory("e727")(EmulatorRequest(port=0, options={"zeroed": "1"}))
    host, _, port = emulator.start().removeprefix("tcp ").rpartition(":")
    stack.callback(emulator.stop)
    return host, int(port)


def _exchange(wire: socket.socket, text: bytes) -> bytes:
    """The least that anybody can do: send, and wait for the end of the reply."""
    wire.sendall(text)
    reply = b""
    while not reply.endswith(b"\n") or reply.endswith(b" \n"):
        reply += wire.recv(4096)
    return reply


def _client(host: str, port: int) -> Any:
    """PI's own client, connected; ``None`` where it is not installed."""
    if importlib.util.find_spec("pipython") is None:
        return None
    pipython = importlib.import_module("pipython")
    wire = importlib.import_module("pipython.pidevice.interfaces.pisocket").PISocket(host, port)
    # It disconnects by itself when it is forgotten, and trips over a second time.
    return pipython.GCSDevice(gateway=wire)


def _row(what: str, ours: Callable[[], object], peer: Callable[[], object] | None, name: str) -> BenchmarkRow:
    note = _ABSENT if peer is None else "over loopback to the emulator, which takes most of the time"
    times = time_alternately(ours, peer, seconds=0.5)
    return time_row(f"drivers: E-727 {what}", times, name, "us", note)


def _pipython_name() -> str:
    """PI's client with its version."""
    try:
        return f"PIPython {importlib.metadata.version('PIPython')}"
    except importlib.metadata.PackageNotFoundError:
        return "PIPython"
