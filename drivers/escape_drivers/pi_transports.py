"""Wires to a PI controller: bytes over the network or a serial line."""

from __future__ import annotations

import contextlib
import socket
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    from serial import Serial

_SIZE = 65536


class WireLost(Exception):
    """The wire is gone; the message says what to look at."""


class Transport(Protocol):
    """A wire.

    Attributes
    ----------
    where
        What is connected, for messages.
    """

    where: str

    def open(self) -> None:
        """Connect.

        Raises
        ------
        WireLost
            Nobody is there.
        """
        ...

    def close(self) -> None:
        """Disconnect; may be repeated, never raises."""
        ...

    def write(self, data: bytes) -> None:
        """Send all of it.

        Raises
        ------
        WireLost
            The wire is gone, or takes nothing any more.
        """
        ...

    def read(self, timeout_s: float) -> bytes:
        """What has arrived, as soon as there is something; empty after the time.

        Raises
        ------
        WireLost
            The wire is gone.
        """
        ...


class TcpTransport:
    """The controller's network port; it takes one client at a time.

    Parameters
    ----------
    host, port
        Where it listens.
    connect_s, timeout_s
        Longest wait for a connection, and for the network to take a command.
    """

    def __init__(self, host: str, port: int, connect_s: float, timeout_s: float) -> None:
        self.where = f"{host}:{port}"
        self._address, self._connect_s, self._timeout_s = (host, port), connect_s, timeout_s
        self._socket: socket.socket | None = None

    def open(self) -> None:
        """Connect."""
        try:
            self._socket = socket.create_connection(self._address, timeout=self._connect_s)
        except TimeoutError as error:
            raise WireLost(
                f"no answer from {self.where} within {self._connect_s:g} s; is the controller "
                "switched on, the cable plugged in, and devices.modulator.wire.host its address?"
            ) from error
        except OSError as error:
            raise WireLost(
                f"cannot connect to {self.where} ({error.strerror or error}); is this the "
                "controller's address, and no other program connected to it? It serves one client at a time"
            ) from error
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)

    def close(self) -> None:
        """Disconnect."""
        if self._socket is not None:
            with contextlib.suppress(OSError):
                self._socket.shutdown(socket.SHUT_RDWR)
            self._socket.close()
            self._socket = None

    def write(self, data: bytes) -> None:
        """Send all of it."""
        wire = self._connected()
        wire.settimeout(self._timeout_s)
        try:
            wire.sendall(data)
        except OSError as error:
            raise self._gone(error) from error

    def read(self, timeout_s: float) -> bytes:
        """What has arrived."""
        wire = self._connected()
        # Zero means "do not wait at all": the least that the kernel waits is a millisecond.
        wire.settimeout(timeout_s)
        try:
            data = wire.recv(_SIZE)
        except (TimeoutError, BlockingIOError):
            return b""
        except OSError as error:
            raise self._gone(error) from error
        if not data:
            raise self._gone(None)
        return data

    def _connected(self) -> socket.socket:
        if self._socket is None:
            raise WireLost(f"not connected to {self.where}")
        return self._socket

    def _gone(self, error: OSError | None) -> WireLost:
        how = "the controller hung up" if error is None else str(error.strerror or error)
        return WireLost(
            f"connection to {self.where} lost ({how}); has another client been connected already (it "
            "serves one at a time), has it been switched off or reset, is the cable loose?"
        )


class SerialTransport:
    """A serial line, or USB that looks like one: 8 bits, no parity, 1 stop bit, no flow control.

    Parameters
    ----------
    port
        Device file.
    baud
        Bits per second.
    timeout_s
        Longest wait for the line to take a command.
    """

    def __init__(self, port: str, baud: int, timeout_s: float) -> None:
        self.where = port
        self._baud, self._timeout_s = baud, timeout_s
        self._serial: Serial | None = None

    def open(self) -> None:
        """Open the line for ourselves alone."""
        import serial

        try:
            self._serial = serial.Serial(
                self.where, self._baud, timeout=0, write_timeout=self._timeout_s, exclusive=True
            )
        except (OSError, ValueError) as error:
            raise WireLost(
                f"cannot open {self.where} ({error}); is the cable plugged in, are you in the group "
                "'dialout', and does no other program hold it (also ModemManager and brltty)?"
            ) from error
        # What an earlier owner left in the buffers is no answer to us.
        self._serial.reset_input_buffer()

    def close(self) -> None:
        """Close the line."""
        if self._serial is not None:
            with contextlib.suppress(OSError):
                self._serial.close()
            self._serial = None

    def write(self, data: bytes) -> None:
        """Send all of it."""
        line = self._opened()
        try:
            line.write(data)
        except OSError as error:
            raise self._gone(error) from error

    def read(self, timeout_s: float) -> bytes:
        """What has arrived."""
        line = self._opened()
        try:
            line.timeout = timeout_s
            # One byte is waited for, the others are there already.
            first: bytes = line.read(1)
            return first + bytes(line.read(line.in_waiting)) if first else b""
        except (OSError, TypeError) as error:
            # pyserial trips over its own closed handle with a TypeError when the line is closed meanwhile.
            raise self._gone(error) from error

    def _opened(self) -> Any:
        if self._serial is None:
            raise WireLost(f"{self.where} is not open")
        return self._serial

    def _gone(self, error: Exception) -> WireLost:
        return WireLost(
            f"lost {self.where} ({error}); is the cable plugged in and the controller switched on? "
            "Open again then"
        )
