"""The connection to an adaptive secondary: one question, its answer, and no more than one at a time."""

from __future__ import annotations

import contextlib
import logging
import os
import socket
import time
from collections.abc import Callable
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from escape_drivers.asm import messages as m
from escape_hw.errors import DeviceError, DeviceLost

log = logging.getLogger(__name__)

#: Most bytes taken from the socket at once.
_RECEIVE_BYTES = 65536
#: Numbers of requests and commands begin anew after this one.
_MAX_SEQUENCE = 0xFFFFFFFF
R = TypeVar("R", bound=m.Welcome | m.Ack | m.Done | m.Param | m.HealthReport)


class MirrorRefusal(DeviceError):
    """The mirror refused a request, and nothing of it was done; ``nak`` is its reply."""

    def __init__(self, device: str, nak: m.Nak) -> None:
        super().__init__(device, f"refused ({nak.code.name.lower().replace('_', ' ')}): {nak.text}")
        self.nak = nak


class AsmLink:
    """A TCP connection over which questions are answered one by one.

    An exchange ends with its answer or it ends the connection: after a time-out it is impossible to tell a
    late answer from the next one. Nothing is ever sent twice. Not thread-safe; the driver has a lock.
    Every exchange raises :class:`DeviceLost` when the connection breaks or no answer comes; the connection is
    closed then. ``on_unsolicited`` is called with messages that answer nothing.
    """

    def __init__(
        self,
        name: str,
        address: tuple[str, int],
        role: m.Role,
        make_codec: Callable[[], m.Codec],
        *,
        connect_s: float,
        reply_s: float,
        on_unsolicited: Callable[[m.Reply], None],
    ) -> None:
        self.name, self.address, self._role, self._make_codec = name, address, role, make_codec
        self._connect_s, self._reply_s, self._on_unsolicited_reply = connect_s, reply_s, on_unsolicited
        self._socket: socket.socket | None = None
        self._codec = make_codec()
        self._sequence = self._counter = self._token = 0
        #: When the last answer came, on this computer's monotonic clock, seconds.
        self.last_reply_s = 0.0
        #: Reason for the missing connection.
        self.reason = "it was never connected"

    @property
    def is_up(self) -> bool:
        """True while there is a connection."""
        return self._socket is not None

    def connect(self) -> m.Welcome:
        """Connect and introduce ourselves; resumes the session of an earlier connection.

        Raises
        ------
        MirrorRefusal
            The mirror has an owner already, or speaks no version of ours.
        """
        self.disconnect("it is being connected anew")
        host, port = self.address
        try:
            sock = socket.create_connection(self.address, self._connect_s)
        except OSError as error:
            self.reason = f"cannot be connected ({error})"
            raise DeviceLost(
                self.name, f"no answer at {host}:{port} ({error}); check host, port, network and power"
            ) from error
        _configure_socket(sock)
        self._socket, self._codec, self._sequence = sock, self._make_codec(), 0
        client_name = f"{os.uname().nodename} pid {os.getpid()}"
        try:
            welcome = self.request(m.Hello(self._role, self._token, client_name), m.Welcome)
        except MirrorRefusal as refusal:
            self.disconnect(str(refusal.args[1]))
            raise
        self._token = welcome.token
        return welcome

    def request(self, message: m.Request, answer: type[R]) -> R:
        """Send a request and wait for its answer; raises :class:`MirrorRefusal` if it is refused."""
        sequence = self._next_sequence()
        return self._exchange(self._codec.request(sequence, time.monotonic_ns(), message), answer)

    def command(self, metres: NDArray[np.float64]) -> m.Ack:
        """Send a shape ``(n_act,)`` in metres from flat and wait for its acknowledgement."""
        self._counter = self._counter % _MAX_SEQUENCE + 1
        data = self._codec.command(self._next_sequence(), time.monotonic_ns(), self._counter, metres)
        return self._exchange(data, m.Ack)

    def _next_sequence(self) -> int:
        """The next sequence number; 0 marks unsolicited messages."""
        self._sequence = self._sequence % _MAX_SEQUENCE + 1
        return self._sequence

    def receive(self, timeout_s: float) -> list[m.Reply]:
        """Unsolicited messages received within a time, with those that arrive together."""
        try:
            return self._read(time.monotonic() + timeout_s)
        except TimeoutError:
            return []

    def disconnect(self, reason: str) -> None:
        """Close the connection, if there is one."""
        if self._socket is not None:
            with contextlib.suppress(OSError):
                # The connection may already be closed.
                self._socket.close()
            self._socket, self.reason = None, reason

    def connection_lost_error(self) -> DeviceLost:
        """The error of a mirror without connection."""
        host, port = self.address
        return DeviceLost(
            self.name,
            f"link to {host}:{port} lost: {self.reason}; nothing is sent twice, and without news the mirror "
            "first holds its shape and then rests; see to the cause, then open it again",
        )

    def _exchange(self, data: bytes | bytearray, answer: type[R]) -> R:
        if self._socket is None:
            raise self.connection_lost_error()
        expected, deadline = self._sequence, time.monotonic() + self._reply_s
        try:
            self._socket.settimeout(self._reply_s)
            self._socket.sendall(data)
        except OSError as error:
            self.disconnect(f"a request could not be sent ({error or type(error).__name__})")
            raise self.connection_lost_error() from error
        try:
            while True:
                found = self._find_reply(expected, self._read(deadline))
                if found is not None:
                    break
        except TimeoutError as error:
            self.disconnect(f"no answer within {self._reply_s:g} s")
            raise self.connection_lost_error() from error
        if isinstance(found, m.Nak):
            raise MirrorRefusal(self.name, found)
        if not isinstance(found, answer):
            self.disconnect(f"a {type(found).__name__} came where a {answer.__name__} was due")
            raise self.connection_lost_error()
        return found

    def _find_reply(self, expected: int, replies: list[m.Reply]) -> m.Reply | None:
        """The answer among what came; news go to the listener, late answers are logged."""
        answer: m.Reply | None = None
        for reply in replies:
            if reply.echo == expected and answer is None:
                answer = reply
            elif reply.echo == 0:
                self._on_unsolicited_reply(reply)
            else:
                log.warning(
                    "%s: an answer to request %d came while %d was due", self.name, reply.echo, expected
                )
        return answer

    def _read(self, deadline: float) -> list[m.Reply]:
        """Replies received before a deadline; raises ``TimeoutError`` if none came."""
        while True:
            if self._socket is None:
                raise self.connection_lost_error()
            remaining_s = deadline - time.monotonic()
            if remaining_s <= 0:
                raise TimeoutError
            try:
                self._socket.settimeout(remaining_s)
                data = self._socket.recv(_RECEIVE_BYTES)
                if not data:
                    raise ConnectionResetError("the mirror closed it")
                replies = self._codec.feed(data)
            except TimeoutError:
                raise
            except OSError as error:
                self.disconnect(f"{error}")
                raise self.connection_lost_error() from error
            except m.ProtocolError as error:
                self.disconnect(f"it sent what the protocol does not allow: {error}")
                raise self.connection_lost_error() from error
            if replies:
                self.last_reply_s = time.monotonic()
                return replies


def _configure_socket(sock: socket.socket) -> None:
    """Disable Nagle's algorithm and enable keep-alive, which detects a peer that disappeared."""
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option, value in ((socket.TCP_KEEPIDLE, 1), (socket.TCP_KEEPINTVL, 1), (socket.TCP_KEEPCNT, 3)):
        sock.setsockopt(socket.IPPROTO_TCP, option, value)
