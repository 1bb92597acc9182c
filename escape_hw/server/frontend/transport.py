"""The front's sockets: what comes in is bounded, checked and counted; nothing here waits for anybody."""

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

#: Longest request, bytes; a message beyond the second number breaks its connection.
MAX_REQUEST_BYTES, _MAX_MESSAGE_BYTES = 64 * 1024, 1024 * 1024
#: Longest number of a request, bytes.
_MAX_ID_BYTES = 64
#: Messages that wait for a slow client before further ones are dropped.
_SEND_QUEUE = 200
#: Messages taken in one go, so that a flood leaves time for everything else.
_MAX_BATCH = 100


@dataclass(frozen=True, slots=True)
class ReplyRoute:
    """Where an answer goes: through which gate, to which connection, to which of its requests."""

    pair_index: int
    connection: bytes
    number: bytes

    @property
    def sender(self) -> bytes:
        """The connection, told apart from those at other gates."""
        return bytes([self.pair_index]) + self.connection


@dataclass(frozen=True, slots=True)
class IncomingRequest:
    """A request and where its answer goes."""

    route: ReplyRoute
    request: AnyRequest


class ZmqTransport:
    """Requests in, answers and events out, through one gate for this machine and one for others.

    Parameters
    ----------
    context
        ZeroMQ's.

    Attributes
    ----------
    refused
        Messages that were no requests.
    serial
        Of the newest state that was told; stands in every answer, for clients that look at the state next.
    """

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]]) -> None:
        self._context, self.refused, self.serial = context, 0, 0
        self._socket_pairs: list[tuple[zmq.Socket[bytes], zmq.Socket[bytes]]] = []

    @property
    def sockets(self) -> tuple[zmq.Socket[bytes], ...]:
        """What to poll for requests."""
        return tuple(router for router, _ in self._socket_pairs)

    def open(self, *endpoints: Endpoint, keys: KeyPair | None = None) -> None:
        """Open a gate and listen.

        Parameters
        ----------
        endpoints
            Where.
        keys
            The server's own: clients without a key that is allowed get no answer and no event there.

        Raises
        ------
        ConfigError
            An address is in use, or not this machine's.
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
        """What has arrived; what is no request is refused and counted."""
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
                raise RequestRefused(f"{len(parts) - 1} parts; a request has two: its number and its text")
            if len(parts[2]) > MAX_REQUEST_BYTES:
                raise RequestRefused(f"{len(parts[2])} bytes; a request has at most {MAX_REQUEST_BYTES}")
            return IncomingRequest(route, REQUESTS.validate_json(parts[2]))
        except ValidationError as error:
            self.refuse(route, RequestRefused(f"no request: {first_error(error)}"))
        except RequestRefused as error:
            self.refuse(route, error)
        return None

    def refuse(self, route: ReplyRoute, error: Exception) -> None:
        """Refuse a request, and count it."""
        self.refused += 1
        if self.refused & (self.refused - 1) == 0:  # 1, 2, 4, 8 ...: a flood does not fill the log
            log.warning("request refused (%d so far): %s", self.refused, error)
        self.send_error(route, error)

    def answer(self, route: ReplyRoute, answer: object, data: bytes | None = None) -> None:
        """Answer a request."""
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
            log.info("an answer could not be sent: %s", error)

    def publish(self, topic: str, document: BaseModel | Mapping[str, Any]) -> None:
        """Tell everybody who listens."""
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
        """Hang up."""
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
