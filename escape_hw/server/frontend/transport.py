"""Non-blocking ZeroMQ endpoint of the server; validates and counts incoming messages."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator, Mapping, Sequence
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

log = logging.getLogger(__name__)

#: Longest request in bytes, and longest message, beyond which ZeroMQ closes the connection.
MAX_REQUEST_BYTES, _MAX_MESSAGE_BYTES = 64 * 1024, 1024 * 1024
#: Longest identifier of a request, bytes.
_MAX_ID_BYTES = 64
#: Messages queued for a slow client; further ones are dropped.
_SEND_QUEUE = 200
#: Messages read in one call, so that a flood does not stop everything else.
_MAX_BATCH = 100


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
    serial
        Serial number of the newest published state. Every reply contains it, so that a client can wait for
        the state that shows the effect of its request.
    """

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]]) -> None:
        self._context, self.refused, self.serial = context, 0, 0
        self._socket_pairs: list[tuple[zmq.Socket[bytes], zmq.Socket[bytes]]] = []

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
        for socket in pair:
            socket.setsockopt(zmq.LINGER, 200)
            socket.setsockopt(zmq.SNDHWM, _SEND_QUEUE)
            socket.setsockopt(zmq.RCVHWM, 5 * _SEND_QUEUE)
            socket.setsockopt(zmq.HEARTBEAT_IVL, 2000)
            socket.setsockopt(zmq.HEARTBEAT_TIMEOUT, 10000)
            socket.setsockopt(zmq.MAXMSGSIZE, _MAX_MESSAGE_BYTES)
            if keys is not None:
                socket.curve_server, socket.zap_domain = True, b"escape"
                socket.curve_secretkey, socket.curve_publickey = keys.secret, keys.public
        for endpoint in endpoints:
            for socket, address in zip(pair, (endpoint.requests, endpoint.events), strict=True):
                _bind(socket, address)

    def receive_requests(self) -> Iterator[IncomingRequest]:
        """Yield the requests that have arrived; other messages are refused and counted."""
        for pair_index, (router, _) in enumerate(self._socket_pairs):
            for _ in range(_MAX_BATCH):
                try:
                    parts = router.recv_multipart(zmq.NOBLOCK)
                except zmq.Again:
                    break
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
        try:
            router = self._socket_pairs[route.pair_index][0]
            router.send_multipart(parts if data is None else [*parts, data], zmq.NOBLOCK)
        except zmq.ZMQError as error:
            log.info("a reply could not be sent: %s", error)

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
            for socket in pair:
                socket.close()
        self._socket_pairs.clear()


def _bind(socket: zmq.Socket[bytes], address: str) -> None:
    try:
        socket.bind(address)
    except zmq.ZMQError as error:
        raise ConfigError(f"{address}: {error.strerror}; choose another --port or --bind") from None
    if address.startswith("ipc://"):
        Path(address.removeprefix("ipc://")).chmod(0o600)
