"""Non-blocking ZeroMQ endpoint of the server; validates and counts incoming messages."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import socket
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import zmq
from pydantic import BaseModel, ValidationError

from escape_hw.errors import ConfigError, RequestRefused
from escape_hw.io.documents import to_plain_values
from escape_hw.remote.address import Endpoint
from escape_hw.remote.keys import KeyPair
from escape_hw.remote.requests import REQUESTS, AnyRequest, error_to_document, first_error
from escape_hw.remote.state import State
from escape_hw.server.frontend.backlog import ReplyBacklogs

log = logging.getLogger(__name__)

#: Longest request in bytes, and longest message, beyond which ZeroMQ closes the connection.
MAX_REQUEST_BYTES, _MAX_MESSAGE_BYTES = 64 * 1024, 1024 * 1024
#: Longest identifier of a request, bytes.
_MAX_ID_BYTES = 64
#: Events queued for a slow client; further ones are dropped.
_EVENT_QUEUE = 200
#: Messages of a connection that wait to be read; then ZeroMQ stops reading it.
_RECEIVE_QUEUE = 100
#: Replies of a connection in ZeroMQ's queue; further ones wait in its backlog.
_SEND_QUEUE = 4
#: Messages read in one call, so that a flood does not stop everything else.
_MAX_BATCH = 100
#: Connections whose descriptor is known.
_MAX_DESCRIPTORS = 1000
#: Detection of a host that is gone, in 10 to 20 s.
_KEEPALIVE = {
    zmq.TCP_KEEPALIVE: 1, zmq.TCP_KEEPALIVE_IDLE: 5, zmq.TCP_KEEPALIVE_INTVL: 5, zmq.TCP_KEEPALIVE_CNT: 2,
    zmq.TCP_MAXRT: 10_000,
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class ReplyRoute:
    """Address of a reply: socket pair, connection, and identifier of the request."""

    pair_index: int
    connection: bytes
    number: bytes

    @property
    def sender(self) -> bytes:
        """Identity of the connection among those of all socket pairs."""
        return bytes([self.pair_index]) + self.connection


@dataclass(frozen=True, slots=True)
class IncomingRequest:
    """A request and the address of its reply."""

    route: ReplyRoute
    request: AnyRequest


class ZmqTransport:
    """Receives requests, sends replies and publishes events, on one socket pair per call of :meth:`open`.

    Attributes
    ----------
    refused
        Number of messages that were refused.
    disconnected
        Number of connections that were closed because their clients did not read.
    serial
        Serial number of the newest published state. Every reply contains it, so that a client can wait for
        the state that shows the effect of its request.
    """

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]]) -> None:
        self._context, self.refused, self.disconnected, self.serial = context, 0, 0, 0
        self._socket_pairs: list[tuple[zmq.Socket[bytes], zmq.Socket[bytes]]] = []
        self._backlogs = ReplyBacklogs()
        #: Descriptors of the connections that sent last, and the addresses that they belong to.
        self._descriptors: dict[bytes, int] = {}
        self._local_paths: set[str] = set()
        self._local_ports: set[int] = set()
        #: Called with the ``sender`` of a connection that is closed because its client does not read.
        self.on_disconnect: Callable[[bytes], object] = lambda sender: None

    @property
    def sockets(self) -> tuple[zmq.Socket[bytes], ...]:
        """Sockets to poll for requests."""
        return tuple(router for router, _ in self._socket_pairs)

    def open(self, *endpoints: Endpoint, keys: KeyPair | None = None) -> None:
        """Listen on addresses (ConfigError: one is in use, or does not belong to this computer).

        With the server's ``keys``, only clients with an allowed key get replies and events there.
        """
        pair = (self._context.socket(zmq.ROUTER), self._context.socket(zmq.PUB))
        self._socket_pairs.append(pair)
        for endpoint_socket in pair:
            endpoint_socket.setsockopt(zmq.LINGER, 200)
            endpoint_socket.setsockopt(zmq.RCVHWM, _RECEIVE_QUEUE)
            # Not ZeroMQ's own heartbeat: libzmq 4.3.5 aborts the process when its timer finds a connection
            # that failed while RCVHWM had stopped its input. The system detects hosts that are gone.
            for option, value in _KEEPALIVE.items():
                endpoint_socket.setsockopt(option, value)
            endpoint_socket.setsockopt(zmq.MAXMSGSIZE, _MAX_MESSAGE_BYTES)
            if keys is not None:
                endpoint_socket.curve_server, endpoint_socket.zap_domain = True, b"escape"
                endpoint_socket.curve_secretkey, endpoint_socket.curve_publickey = keys.secret, keys.public
        router, events = pair
        router.setsockopt(zmq.SNDHWM, _SEND_QUEUE)
        events.setsockopt(zmq.SNDHWM, _EVENT_QUEUE)
        # A full queue and a closed connection are reported, and a client that reconnects replaces its old
        # connection at once.
        router.setsockopt(zmq.ROUTER_MANDATORY, 1)
        router.setsockopt(zmq.ROUTER_HANDOVER, 1)
        for endpoint in endpoints:
            for endpoint_socket, address in zip(pair, (endpoint.requests, endpoint.events), strict=True):
                _bind(endpoint_socket, address)
            if endpoint.requests.startswith("ipc://"):
                self._local_paths.add(endpoint.requests.removeprefix("ipc://"))
            else:
                self._local_ports.add(int(endpoint.requests.rpartition(":")[2]))

    def receive_requests(self) -> Iterator[IncomingRequest]:
        """Yield the requests that have arrived; other messages are refused and counted."""
        for pair_index, (router, _) in enumerate(self._socket_pairs):
            for _ in range(_MAX_BATCH):
                try:
                    frames = router.recv_multipart(zmq.NOBLOCK, copy=False)
                except zmq.Again:
                    break
                parts = [frame.bytes for frame in frames]
                self._note_descriptor(bytes([pair_index]) + parts[0], frames[-1])
                incoming = self._parse(pair_index, parts)
                if incoming is not None:
                    yield incoming

    def _parse(self, pair_index: int, parts: Sequence[bytes]) -> IncomingRequest | None:
        number = parts[1] if len(parts) > 1 else b""
        route = ReplyRoute(pair_index, parts[0], number[:_MAX_ID_BYTES])
        try:
            if len(parts) != 3 or len(number) > _MAX_ID_BYTES:
                raise RequestRefused(
                    f"a message of {len(parts) - 1} parts; a request has two: identifier and JSON text"
                )
            if len(parts[2]) > MAX_REQUEST_BYTES:
                raise RequestRefused(
                    f"a message of {len(parts[2])} bytes; a request has at most {MAX_REQUEST_BYTES}"
                )
            return IncomingRequest(route, REQUESTS.validate_json(parts[2]))
        except ValidationError as error:
            self.refuse(route, RequestRefused(f"not a valid request: {first_error(error)}"))
        except RequestRefused as error:
            self.refuse(route, error)
        return None

    def refuse(self, route: ReplyRoute, error: Exception) -> None:
        """Refuse a message, and count it."""
        self.refused += 1
        if self.refused & (self.refused - 1) == 0:  # log the 1st, 2nd, 4th, 8th ... only
            log.warning("request refused (%d so far): %s", self.refused, error)
        self.send_error(route, error)

    def send_reply(self, route: ReplyRoute, answer: object, data: bytes | None = None) -> None:
        """Answer a request, optionally with bytes as a third part."""
        content = answer.model_dump(mode="json") if isinstance(answer, BaseModel) else to_plain_values(answer)
        self._send(route, {"ok": True, "answer": content}, data)

    def send_error(self, route: ReplyRoute, error: Exception | Mapping[str, Any]) -> None:
        """Answer a request with an error."""
        known = error_to_document(error) if isinstance(error, Exception) else dict(error)
        self._send(route, {"ok": False, "error": known}, None)

    def _send(self, route: ReplyRoute, reply: Mapping[str, Any], data: bytes | None) -> None:
        text = json.dumps({**reply, "serial": self.serial}, allow_nan=False)
        parts = [route.connection, route.number, text.encode()]
        if data is not None:
            parts.append(data)
        sender = route.sender
        if sender in self._backlogs or not self._try_send(sender, parts):
            self._backlogs.add(sender, parts)
            self._disconnect_slow_readers()

    def _try_send(self, sender: bytes, parts: Sequence[bytes]) -> bool:
        """Pass a reply to ZeroMQ; false when its queue of this connection is full."""
        try:
            self._socket_pairs[sender[0]][0].send_multipart(parts, zmq.NOBLOCK)
        except zmq.Again:
            return False
        except zmq.ZMQError as error:
            log.debug("a reply was not sent, its client is gone: %s", error)
        return True

    def flush(self) -> bool:
        """Send waiting replies and disconnect slow readers; true while replies wait. Call this regularly."""
        self._backlogs.flush(self._try_send)
        self._disconnect_slow_readers()
        return bool(self._backlogs)

    def _disconnect_slow_readers(self) -> None:
        for sender, reason in self._backlogs.remove_slow():
            self.disconnected += 1
            if self.disconnected & (self.disconnected - 1) == 0:
                log.warning("client disconnected (%d so far): %s", self.disconnected, reason)
            self._shut_down(sender)
            self.on_disconnect(sender)

    def _note_descriptor(self, sender: bytes, frame: zmq.Frame) -> None:
        """Note the descriptor of the connection that a message came through."""
        self._descriptors.pop(sender, None)
        with contextlib.suppress(zmq.ZMQError, ValueError):
            self._descriptors[sender] = int(frame.get(zmq.SRCFD))
        if len(self._descriptors) > _MAX_DESCRIPTORS:
            del self._descriptors[next(iter(self._descriptors))]

    def _shut_down(self, sender: bytes) -> None:
        """Shut a client's connection down; ZeroMQ then closes it and frees its queue.

        The descriptor may belong to a later connection if the client's has just been closed. That one is a
        connection of a client, too, which reconnects; any other descriptor is left alone.
        """
        descriptor = self._descriptors.pop(sender, None)
        if descriptor is None:
            return
        with contextlib.suppress(OSError), socket.socket(fileno=os.dup(descriptor)) as connection:
            name = connection.getsockname()
            if name in self._local_paths or (isinstance(name, tuple) and name[1] in self._local_ports):
                connection.shutdown(socket.SHUT_RDWR)

    def publish(self, topic: str, document: BaseModel | Mapping[str, Any]) -> None:
        """Publish an event."""
        if isinstance(document, State):
            self.serial = document.serial
        text = (
            document.model_dump_json()
            if isinstance(document, BaseModel)
            else json.dumps(to_plain_values(document))
        )
        for _, events in self._socket_pairs:
            try:
                events.send_multipart([topic.encode(), text.encode()], zmq.NOBLOCK)
            except zmq.Again:
                log.debug("event %s dropped", topic)

    def close(self) -> None:
        """Close the sockets."""
        for pair in self._socket_pairs:
            for endpoint_socket in pair:
                endpoint_socket.close()
        self._socket_pairs.clear()


def _bind(socket: zmq.Socket[bytes], address: str) -> None:
    try:
        socket.bind(address)
    except zmq.ZMQError as error:
        raise ConfigError(f"{address}: {error.strerror}; choose another --port or --bind") from None
    if address.startswith("ipc://"):
        Path(address.removeprefix("ipc://")).chmod(0o600)
