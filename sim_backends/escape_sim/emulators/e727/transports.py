"""Transports of the emulated controller (network, serial line, USB), one client at a time, with faults."""

from __future__ import annotations

import abc
import contextlib
import os
import select
import socket
import threading
import tty
from collections.abc import Callable, Mapping

from escape_hw.errors import ConfigError
from escape_sim.emulators.e727.controller import E727Controller
from escape_sim.emulators.options import current_word

#: Kinds of fault: lost command; lost, late, repeated or cut reply; noise before it; closed connection,
#: without or with a reset or a power cut of the controller; no replies any more.
FAULT_KINDS = (
    "drop_command", "drop_reply", "delay", "double", "truncate", "garbage", "close", "reset", "power_cut",
    "stall",
)  # fmt: skip
_RENAMED_FAULTS = {
    "lose": "drop_command", "drop": "drop_reply", "late": "delay", "power": "power_cut",
}  # fmt: skip
_CUTS = ("close", "reset", "power_cut")


def parse_fault(word: str) -> str:
    """A kind of fault, of :data:`FAULT_KINDS`; raises ``ConfigError`` if it is none."""
    kind = current_word(word, _RENAMED_FAULTS)
    if kind not in FAULT_KINDS:
        raise ConfigError(f"fault {word!r}: write KIND@NUMBER, KIND one of {', '.join(FAULT_KINDS)}")
    return kind


class ConnectionCut(Exception):
    """A fault ends the connection."""


class FaultInjector:
    """Applies faults, given by the number of the command since the start, to replies.

    ``is_stalled`` is true once no command is answered any more.
    """

    def __init__(self, faults: Mapping[int, str] | None = None) -> None:
        self._faults = dict(faults or {})
        self._delayed = b""
        self._n_commands = 0
        self.is_stalled = False

    def next_fault(self) -> str:
        """Fault of the next command; empty without one."""
        kind = self._faults.get(self._n_commands, "")
        self._n_commands += 1
        self.is_stalled = self.is_stalled or kind == "stall"
        return kind

    def apply(self, kind: str, reply: bytes) -> bytes:
        """Bytes sent for a reply; a delayed reply is sent with the next one."""
        if self.is_stalled or kind in ("drop_reply", "drop_command"):
            return b""
        if kind == "delay":
            self._delayed += reply
            return b""
        delayed, self._delayed = self._delayed, b""
        if kind == "double":
            reply += reply
        elif kind == "truncate":
            reply = reply[: len(reply) // 2]
        elif kind == "garbage":
            reply = b"\xb1\x00%$ 17=x\n" + reply
        return delayed + reply


#: Period in seconds at which a server checks whether it should stop.
_POLL_S = 0.05


class ClientSession:
    """Passes a client's bytes to the controller and its replies back, with faults.

    ``final_condition`` is the condition in which the last client left the stage; empty before.
    """

    def __init__(self, controller: E727Controller, faults: FaultInjector) -> None:
        self._controller, self._faults = controller, faults
        self.final_condition = ""

    def feed(self, data: bytes) -> bytes:
        """Process received bytes; returns the bytes to send. Raises ConnectionCut if a fault requires it."""
        outgoing = b""
        for line in self._controller.receive(data):
            kind = self._faults.next_fault()
            is_lost = kind == "drop_command" or self._faults.is_stalled
            reply = b"" if is_lost else self._controller.execute(line)
            if kind in ("reset", "power_cut"):
                self._controller.reset(power_cut=kind == "power_cut")
            if kind in _CUTS:
                raise ConnectionCut(kind)
            outgoing += self._faults.apply(kind, reply)
        return outgoing

    def finish(self) -> None:
        """The client has disconnected."""
        self.final_condition = self._controller.end_session()


class E727Server(abc.ABC):
    """A server in its own thread, with the session of its client."""

    def __init__(self, controller: E727Controller, faults: FaultInjector) -> None:
        self._controller = controller
        self.client_session = ClientSession(controller, faults)
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    @abc.abstractmethod
    def start(self) -> str:
        """Start; returns the address."""

    def stop(self) -> None:
        """End the connection and stop; may be repeated."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        self._close()

    def _start_thread(self, serve: Callable[[], None]) -> None:
        self._stop.clear()
        self._thread = threading.Thread(target=serve, name=type(self).__name__, daemon=True)
        self._thread.start()

    @abc.abstractmethod
    def _close(self) -> None:
        """Close what :meth:`start` opened."""


class TcpServer(E727Server):
    """TCP server for one client; further clients are refused. Port 0 takes any free port."""

    def __init__(self, controller: E727Controller, faults: FaultInjector, host: str, port: int) -> None:
        super().__init__(controller, faults)
        self._address = (host, port)
        self._listener: socket.socket | None = None

    def start(self) -> str:
        """Listen; returns ``tcp HOST:PORT``, raises ConfigError if the address cannot be used."""
        host, port = self._address
        try:
            self._listener = listener = socket.create_server((host, port))
        except OSError as error:
            raise ConfigError(
                f"cannot listen on {host}:{port} ({error.strerror or error}); choose another --port "
                "(0: any) or --host"
            ) from error
        self._start_thread(lambda: self._serve(listener))
        return f"tcp {listener.getsockname()[0]}:{self.port}"

    @property
    def port(self) -> int:
        """The port in use."""
        if self._listener is None:
            raise RuntimeError("the server has not been started")
        return int(self._listener.getsockname()[1])

    def _close(self) -> None:
        if self._listener is not None:
            self._listener.close()
            self._listener = None

    def _serve(self, listener: socket.socket) -> None:
        client: socket.socket | None = None
        while not self._stop.is_set():
            ready, _, _ = select.select([listener, *([client] if client else [])], [], [], _POLL_S)
            # A disconnection is processed before a new client that connects at the same time.
            if client in ready and client is not None and not self._exchange(client):
                self._close_client(client)
                client = None
            if listener in ready:
                client = self._accept_client(listener, client)
        if client is not None:
            self._close_client(client)

    def _accept_client(self, listener: socket.socket, client: socket.socket | None) -> socket.socket | None:
        new_client, address = listener.accept()
        if client is not None:
            self._controller.state.report_violation(
                f"second client from {address[0]} refused: the controller serves one at a time"
            )
            new_client.close()
            return client
        new_client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        new_client.settimeout(1.0)
        return new_client

    def _exchange(self, client: socket.socket) -> bool:
        """Process received bytes; False if the connection is to be closed."""
        try:
            data = client.recv(65536)
            if data and (outgoing := self.client_session.feed(data)):
                client.sendall(outgoing)
        except (OSError, ConnectionCut):
            return False
        return bool(data)

    def _close_client(self, client: socket.socket) -> None:
        client.close()
        self.client_session.finish()


class PtyServer(E727Server):
    """Server on a pseudo-terminal, as on a serial line or USB-serial adapter."""

    _descriptors: tuple[int, int] | None = None

    def start(self) -> str:
        """Open the terminal; returns ``pty /dev/pts/N``."""
        ours, theirs = os.openpty()
        tty.setraw(theirs)
        # The other end is kept open here, too: reading fails when no process has opened it.
        self._descriptors = (ours, theirs)
        self._start_thread(lambda: self._serve(ours))
        return f"pty {os.ttyname(theirs)}"

    def stop(self) -> None:
        """Close the terminal."""
        super().stop()
        self.client_session.finish()

    def _close(self) -> None:
        descriptors, self._descriptors = self._descriptors, None
        for end in descriptors or ():
            with contextlib.suppress(OSError):
                os.close(end)

    def _serve(self, ours: int) -> None:
        while not self._stop.is_set():
            ready, _, _ = select.select([ours], [], [], _POLL_S)
            if not ready:
                continue
            try:
                outgoing = self.client_session.feed(os.read(ours, 65536))
                while outgoing:
                    outgoing = outgoing[os.write(ours, outgoing) :]
            except (OSError, ConnectionCut):
                self._close()
                return
