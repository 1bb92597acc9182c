"""The front's sockets: what comes in is bounded, checked and counted; nothing here waits for anybody."""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import zmq
from pydantic import BaseModel, ValidationError

from escape_hw.errors import ConfigError, RequestRefused
from escape_hw.io.documents import plain
from escape_hw.remote.address import Endpoint
from escape_hw.remote.faults import to_wire
from escape_hw.remote.requests import REQUESTS, AnyRequest

log = logging.getLogger(__name__)

#: Longest request, bytes; a message beyond the second number breaks its connection.
LONGEST, _CUT_OFF = 64 * 1024, 1024 * 1024
#: Longest number of a request, bytes.
_LONGEST_ID = 64
#: Messages that wait for a slow client before further ones are dropped.
_WAITING = 200
#: Messages taken in one go, so that a flood leaves time for everything else.
_AT_ONCE = 100


@dataclass(frozen=True, slots=True)
class Letter:
    """A request and where its answer goes."""

    route: bytes
    number: bytes
    request: AnyRequest


class Door:
    """Requests in, answers and events out.

    Parameters
    ----------
    context
        ZeroMQ's.

    Attributes
    ----------
    refused
        Messages that were no requests.
    """

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]]) -> None:
        self.refused = 0
        self._router, self._events = context.socket(zmq.ROUTER), context.socket(zmq.PUB)
        for socket in (self._router, self._events):
            socket.setsockopt(zmq.LINGER, 200)
            socket.setsockopt(zmq.SNDHWM, _WAITING)
            socket.setsockopt(zmq.HEARTBEAT_IVL, 2000)
            socket.setsockopt(zmq.HEARTBEAT_TIMEOUT, 10000)
            socket.setsockopt(zmq.MAXMSGSIZE, _CUT_OFF)
        self._router.setsockopt(zmq.RCVHWM, 5 * _WAITING)

    @property
    def socket(self) -> zmq.Socket[bytes]:
        """What to poll for requests."""
        return self._router

    def secure(self, secret: bytes, public: bytes) -> None:
        """Ask every client for its key from here on; see :mod:`escape_hw.remote.keys`."""
        for socket in (self._router, self._events):
            socket.curve_server = True
            socket.curve_secretkey, socket.curve_publickey = secret, public

    def bind(self, endpoint: Endpoint) -> None:
        """Listen.

        Raises
        ------
        ConfigError
            The address is in use, or not this machine's.
        """
        for socket, address in ((self._router, endpoint.requests), (self._events, endpoint.events)):
            try:
                socket.bind(address)
            except zmq.ZMQError as error:
                raise ConfigError(f"{address}: {error.strerror}; choose another --port or --bind") from None
            if address.startswith("ipc://"):
                Path(address.removeprefix("ipc://")).chmod(0o600)

    def letters(self) -> Iterator[Letter]:
        """What has arrived; what is no request is refused and counted."""
        for _ in range(_AT_ONCE):
            try:
                parts = self._router.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return
            letter = self._opened(parts)
            if letter is not None:
                yield letter

    def _opened(self, parts: Sequence[bytes]) -> Letter | None:
        route, number = parts[0], parts[1] if len(parts) > 1 else b""
        try:
            if len(parts) != 3 or len(number) > _LONGEST_ID:
                raise RequestRefused(f"{len(parts) - 1} parts; a request has two: its number and its text")
            if len(parts[2]) > LONGEST:
                raise RequestRefused(f"{len(parts[2])} bytes; a request has at most {LONGEST}")
            return Letter(route, number, REQUESTS.validate_json(parts[2]))
        except ValidationError as error:
            first = error.errors(include_url=False, include_input=False)[0]
            place = ".".join(map(str, first["loc"])) or "the text"
            self.refuse(route, number[:_LONGEST_ID], RequestRefused(f"no request: {place}: {first['msg']}"))
        except RequestRefused as error:
            self.refuse(route, number[:_LONGEST_ID], error)
        return None

    def refuse(self, route: bytes, number: bytes, error: Exception) -> None:
        """Refuse a request, and count it."""
        self.refused += 1
        if self.refused & (self.refused - 1) == 0:  # 1, 2, 4, 8 ...: a flood does not fill the log
            log.warning("request refused (%d so far): %s", self.refused, error)
        self.fail(route, number, error)

    def answer(self, route: bytes, number: bytes, answer: object, data: bytes | None = None) -> None:
        """Answer a request."""
        said = answer.model_dump(mode="json") if isinstance(answer, BaseModel) else plain(answer)
        self._send(route, number, {"ok": True, "answer": said}, data)

    def fail(self, route: bytes, number: bytes, error: Exception | Mapping[str, Any]) -> None:
        """Answer a request with an error."""
        known = to_wire(error) if isinstance(error, Exception) else dict(error)
        self._send(route, number, {"ok": False, "error": known}, None)

    def _send(self, route: bytes, number: bytes, reply: Mapping[str, Any], data: bytes | None) -> None:
        parts = [route, number, json.dumps(reply, allow_nan=False).encode()]
        try:
            self._router.send_multipart(parts if data is None else [*parts, data], zmq.NOBLOCK)
        except zmq.ZMQError as error:
            log.info("an answer could not be sent: %s", error)

    def publish(self, topic: str, document: BaseModel | Mapping[str, Any]) -> None:
        """Tell everybody who listens."""
        text = document.model_dump_json() if isinstance(document, BaseModel) else json.dumps(plain(document))
        try:
            self._events.send_multipart([topic.encode(), text.encode()], zmq.NOBLOCK)
        except zmq.Again:
            log.debug("event %s dropped", topic)

    def close(self) -> None:
        """Hang up."""
        self._router.close()
        self._events.close()


def private_umask() -> int:
    """Let nobody else into sockets made from here on; returns the former mask."""
    return os.umask(0o077)
