"""Transports of the emulated controller (network, serial line, USB endpoints), one client at a time, with scripted faults."""

from __future__ import annotations

import contextlib
import os
import select
import socket
import threading
import time
import tty
from dataclasses import dataclass
from typing import Protocol

from escape_hw.errors import ConfigError
from escape_sim.emulators.e727.controller import E727Controller

#: Lost command; lost, late, doubled, cut reply; noise before it; hang-up; reset; no answer any more.
FAULT_KINDS = ("lose", "drop", "late", "double", "truncate", "garbage", "close", "reset", "power", "stall")


@dataclass(frozen=True, slots=True)
class WireFault:
    """One fault.

    Parameters
    ----------
    kind
        One of :data:`FAULT_KINDS`.
    at
        Number of the command, counted from 0 since the emulator started.
    """

    kind: str
    at: int


def parse_fault_script(text: str) -> tuple[WireFault, ...]:
    """``drop@12,late@30`` as faults.

    Raises
    ------
    ConfigError
        Not of that form.
    """
    faults = []
    for part in filter(None, text.split(",")):
        kind, _, at = part.strip().partition("@")
        if kind not in FAULT_KINDS or not at.isdigit():
            raise ConfigError(f"fault {part!r}: write KIND@NUMBER, KIND one of {', '.join(FAULT_KINDS)}")
        faults.append(WireFault(kind, int(at)))
    return tuple(faults)


class ConnectionCut(Exception):
    """The wire is to be cut now."""


class FaultInjector:
    """Passes replies on, or not.

    Parameters
    ----------
    faults
        What is to happen when.
    """

    def __init__(self, faults: tuple[WireFault, ...] = ()) -> None:
        self._faults = {fault.at: fault.kind for fault in faults}
        self._delayed = b""
        self._n_commands = 0
        self.is_stalled = False

    def next_fault(self) -> str:
        """The fault of the next command; empty: none."""
        kind = self._faults.get(self._n_commands, "")
        self._n_commands += 1
        self.is_stalled = self.is_stalled or kind == "stall"
        return kind

    def apply(self, kind: str, reply: bytes) -> bytes:
        """What reaches the client of a reply."""
        if self.is_stalled or kind in ("drop", "lose"):
            return b""
        if kind == "late":
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


#: How long a server sleeps before it looks whether it should stop, in seconds.
_POLL_S = 0.05


class ClientSession:
    """One client's bytes through the faults to the controller and back.

    Parameters
    ----------
    controller
        Who answers.
    wire
        The faults.

    Attributes
    ----------
    left
        In what condition the last client left the stage; empty before anybody left.
    """

    def __init__(self, controller: E727Controller, faults: FaultInjector) -> None:
        self._controller, self._faults = controller, faults
        self.final_condition = ""

    def feed(self, data: bytes) -> bytes:
        """What goes back to the client.

        Raises
        ------
        HangUp
            The script cuts the wire now; what the exception carries has been sent before.
        """
        outgoing = b""
        for line in self._controller.receive(data):
            kind = self._faults.next_fault()
            reply = b"" if kind == "lose" or self._faults.is_stalled else self._controller.execute(line)
            if kind in ("reset", "power"):
                self._controller.reset(power_cut=kind == "power")
            if kind in ("close", "reset", "power"):
                raise ConnectionCut(kind)
            outgoing += self._faults.apply(kind, reply)
        return outgoing

    def finish(self) -> None:
        """The client has gone."""
        self.final_condition = self._controller.end_session()


class E727Server(Protocol):
    """Something that listens in a thread of its own.

    Attributes
    ----------
    conversation
        With whoever is connected.
    """

    client_session: ClientSession

    def start(self) -> str:
        """Begin; returns where."""
        ...

    def stop(self) -> None:
        """End."""
        ...


class TcpServer:
    """Listens on the network; a second client is turned away while the first is connected.

    Parameters
    ----------
    controller, wire
        Who answers, through which faults.
    host, port
        Where; port 0: any that is free.
    """

    def __init__(self, controller: E727Controller, faults: FaultInjector, host: str, port: int) -> None:
        self._controller, self._address = controller, (host, port)
        self.client_session = ClientSession(controller, faults)
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._listener: socket.socket | None = None

    def start(self) -> str:
        """Begin to listen; returns ``tcp HOST:PORT``."""
        host, port = self._address
        try:
            self._listener = socket.create_server((host, port))
        except OSError as error:
            raise ConfigError(
                f"cannot listen on {host}:{port} ({error.strerror or error}); choose another --port, "
                "0 for any"
            ) from error
        self._stop.clear()
        self._thread = threading.Thread(target=self._serve, name="e727-tcp", daemon=True)
        self._thread.start()
        return "tcp {}:{}".format(*self._listener.getsockname()[:2])

    @property
    def port(self) -> int:
        """The port listened on."""
        if self._listener is None:
            raise RuntimeError("the server has not been started")
        return int(self._listener.getsockname()[1])

    def stop(self) -> None:
        """Hang up and stop listening."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        if self._listener is not None:
            self._listener.close()
            self._listener = None

    def _serve(self) -> None:
        listener = self._listener
        assert listener is not None
        client: socket.socket | None = None
        while not self._stop.is_set():
            ready, _, _ = select.select([listener, *([client] if client else [])], [], [], _POLL_S)
            # Who hangs up makes room, also for one who rang at the same moment.
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
        """One exchange; false when the client has gone or is to go."""
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


class PtyServer:
    """Answers on a pseudo-terminal, as on a serial line or USB-serial adapter.

    Parameters
    ----------
    controller, wire
        Who answers, through which faults.
    """

    def __init__(self, controller: E727Controller, faults: FaultInjector) -> None:
        self.client_session = ClientSession(controller, faults)
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._descriptors: tuple[int, int] | None = None

    def start(self) -> str:
        """Begin; returns ``pty /dev/pts/N``."""
        ours, theirs = os.openpty()
        tty.setraw(theirs)
        # The other end stays open here too: a terminal that nobody holds reports errors for ever.
        self._descriptors = (ours, theirs)
        self._stop.clear()
        self._thread = threading.Thread(target=self._serve, args=(ours,), name="e727-pty", daemon=True)
        self._thread.start()
        return f"pty {os.ttyname(theirs)}"

    def stop(self) -> None:
        """Pull the plug."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        self._close()
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


class UsbPipe:
    """The bulk endpoints of a USB controller, for a stand-in of libusb.

    Parameters
    ----------
    controller, wire
        Who answers, through which faults.
    """

    def __init__(self, controller: E727Controller, faults: FaultInjector) -> None:
        self._controller = controller
        self.client_session = ClientSession(controller, faults)
        self._outgoing = bytearray()
        self.is_plugged = True

    @property
    def serial(self) -> str:
        """Serial number in the device's descriptor."""
        return self._controller.settings.serial

    def write(self, data: bytes) -> None:
        """Bulk transfer to the controller.

        Raises
        ------
        ConnectionError
            Unplugged.
        """
        if not self.is_plugged:
            raise ConnectionError
        if len(data) % 2:
            self._controller.state.report_violation(
                f"a USB transfer of {len(data)} bytes; pad to an even number"
            )
        try:
            self._outgoing += self.client_session.feed(data)
        except ConnectionCut:
            self.is_plugged = False
            raise ConnectionError from None

    def read(self, size: int, timeout_s: float) -> bytes:
        """Bulk transfer from the controller; empty when nothing comes in time.

        Raises
        ------
        ConnectionError
            Unplugged.
        """
        deadline = time.monotonic() + timeout_s
        while not self._outgoing and time.monotonic() < deadline:
            if not self.is_plugged:
                raise ConnectionError
            time.sleep(min(0.002, timeout_s))
        data, self._outgoing = bytes(self._outgoing[:size]), self._outgoing[size:]
        return data
