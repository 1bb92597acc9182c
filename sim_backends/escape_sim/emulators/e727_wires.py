"""The wires of the emulated controller: network, serial line, USB; one client at a time on each."""

from __future__ import annotations

import contextlib
import os
import select
import socket
import threading
import time
import tty
from typing import Protocol

from escape_hw.errors import ConfigError
from escape_sim.emulators.e727_controller import Controller
from escape_sim.emulators.faults import FaultyWire, HangUp

#: How long a server sleeps before it looks whether it should stop, in seconds.
_LOOK_S = 0.05


class Conversation:
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

    def __init__(self, controller: Controller, wire: FaultyWire) -> None:
        self._controller, self._wire = controller, wire
        self.left = ""

    def feed(self, data: bytes) -> bytes:
        """What goes back to the client.

        Raises
        ------
        HangUp
            The script cuts the wire now; what the exception carries has been sent before.
        """
        back = b""
        for line in self._controller.received(data):
            kind = self._wire.take()
            reply = b"" if kind == "lose" or self._wire.stalled else self._controller.answer(line)
            if kind in ("reset", "power"):
                self._controller.reset(power_cut=kind == "power")
            if kind in ("close", "reset", "power"):
                raise HangUp(kind)
            back += self._wire.passed(kind, reply)
        return back

    def ended(self) -> None:
        """The client has gone."""
        self.left = self._controller.hang_up()


class Server(Protocol):
    """Something that listens in a thread of its own.

    Attributes
    ----------
    conversation
        With whoever is connected.
    """

    conversation: Conversation

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

    def __init__(self, controller: Controller, wire: FaultyWire, host: str, port: int) -> None:
        self._controller, self._where = controller, (host, port)
        self.conversation = Conversation(controller, wire)
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._listener: socket.socket | None = None

    def start(self) -> str:
        """Begin to listen; returns ``tcp HOST:PORT``."""
        host, port = self._where
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
            ready, _, _ = select.select([listener, *([client] if client else [])], [], [], _LOOK_S)
            # Who hangs up makes room, also for one who rang at the same moment.
            if client in ready and client is not None and not self._talk(client):
                self._hang_up(client)
                client = None
            if listener in ready:
                client = self._welcome(listener, client)
        if client is not None:
            self._hang_up(client)

    def _welcome(self, listener: socket.socket, client: socket.socket | None) -> socket.socket | None:
        other, address = listener.accept()
        if client is not None:
            self._controller.state.complain(
                f"second client from {address[0]} refused: the controller serves one at a time"
            )
            other.close()
            return client
        other.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        other.settimeout(1.0)
        return other

    def _talk(self, client: socket.socket) -> bool:
        """One exchange; false when the client has gone or is to go."""
        try:
            data = client.recv(65536)
            if data and (back := self.conversation.feed(data)):
                client.sendall(back)
        except (OSError, HangUp):
            return False
        return bool(data)

    def _hang_up(self, client: socket.socket) -> None:
        client.close()
        self.conversation.ended()


class PtyServer:
    """Answers on a pseudo-terminal, as on a serial line or USB-serial adapter.

    Parameters
    ----------
    controller, wire
        Who answers, through which faults.
    """

    def __init__(self, controller: Controller, wire: FaultyWire) -> None:
        self.conversation = Conversation(controller, wire)
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._ends: tuple[int, int] | None = None

    def start(self) -> str:
        """Begin; returns ``pty /dev/pts/N``."""
        ours, theirs = os.openpty()
        tty.setraw(theirs)
        # The other end stays open here too: a terminal that nobody holds reports errors for ever.
        self._ends = (ours, theirs)
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
        self.conversation.ended()

    def _close(self) -> None:
        ends, self._ends = self._ends, None
        for end in ends or ():
            with contextlib.suppress(OSError):
                os.close(end)

    def _serve(self, ours: int) -> None:
        while not self._stop.is_set():
            ready, _, _ = select.select([ours], [], [], _LOOK_S)
            if not ready:
                continue
            try:
                back = self.conversation.feed(os.read(ours, 65536))
                while back:
                    back = back[os.write(ours, back) :]
            except (OSError, HangUp):
                self._close()
                return


class UsbPipe:
    """The bulk endpoints of a USB controller, for a stand-in of libusb.

    Parameters
    ----------
    controller, wire
        Who answers, through which faults.
    """

    def __init__(self, controller: Controller, wire: FaultyWire) -> None:
        self._controller = controller
        self.conversation = Conversation(controller, wire)
        self._back = bytearray()
        self.plugged = True

    @property
    def serial(self) -> str:
        """Serial number in the device's descriptor."""
        return self._controller.make.serial

    def write(self, data: bytes) -> None:
        """Bulk transfer to the controller.

        Raises
        ------
        ConnectionError
            Unplugged.
        """
        if not self.plugged:
            raise ConnectionError
        if len(data) % 2:
            self._controller.state.complain(f"a USB transfer of {len(data)} bytes; pad to an even number")
        try:
            self._back += self.conversation.feed(data)
        except HangUp:
            self.plugged = False
            raise ConnectionError from None

    def read(self, size: int, timeout_s: float) -> bytes:
        """Bulk transfer from the controller; empty when nothing comes in time.

        Raises
        ------
        ConnectionError
            Unplugged.
        """
        deadline = time.monotonic() + timeout_s
        while not self._back and time.monotonic() < deadline:
            if not self.plugged:
                raise ConnectionError
            time.sleep(min(0.002, timeout_s))
        data, self._back = bytes(self._back[:size]), self._back[size:]
        return data
