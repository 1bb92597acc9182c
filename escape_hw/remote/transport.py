"""ZeroMQ endpoint of a client: one thread owns the sockets, and callers wait with a time-out."""

from __future__ import annotations

import itertools
import json
import logging
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeoutError
from typing import Any

import zmq

from escape_hw.errors import ClientUnknown, ServerGone
from escape_hw.remote.address import Endpoint
from escape_hw.remote.requests import error_from_document
from escape_hw.supervision import BackgroundThread

log = logging.getLogger(__name__)

#: Longest wait for an ordinary reply, and for one that is sent when the mirror is flat, seconds.
TIMEOUT_S, SLOW_TIMEOUT_S = 3.0, 30.0
#: Interval of heartbeats, seconds.
_HEARTBEAT_S = 0.5
#: Identifier of heartbeats, whose reply no caller waits for; the number of the last request follows.
_HEARTBEAT = b"h"
#: Why a request failed that was sent to a server that has ended meanwhile.
_LOST_TEXT = "the server ended before it replied; look at the state, and repeat the request if necessary"
#: Largest reply that is accepted, bytes.
_LARGEST = 256 << 20

#: The answer, its bytes, and the serial number of the state that shows the effect of the request.
Reply = tuple[Any, bytes, int]
Keys = tuple[bytes, bytes, bytes]


class ClientTransport:
    """A connection to a server.

    Parameters
    ----------
    endpoint
        Addresses of the server.
    on_event
        Called with topic and document of every event, in the thread of the sockets.
    heartbeat
        Returns the message to send twice a second, or ``None``. Its argument is whether the
        server refused the last one.
    on_heartbeat_answer
        Called with the answer to a heartbeat, in the thread of the sockets.
    keys
        The server's public key, this client's public and secret key; ``None`` on the same computer.
    """

    def __init__(
        self,
        endpoint: Endpoint,
        on_event: Callable[[str, dict[str, Any]], object],
        heartbeat: Callable[[bool], Mapping[str, Any] | None],
        on_heartbeat_answer: Callable[[Any], object],
        keys: Keys | None = None,
    ) -> None:
        self._on_event, self._heartbeat = on_event, heartbeat
        self._on_heartbeat_answer = on_heartbeat_answer
        self._context = zmq.Context()
        self._requests = self._socket(zmq.DEALER, endpoint.requests, keys)
        self._events = self._socket(zmq.SUB, endpoint.events, keys)
        self._events.setsockopt(zmq.SUBSCRIBE, b"")
        self._wake_receiver, self._wake_sender = (self._context.socket(zmq.PAIR) for _ in range(2))
        self._wake_receiver.bind("inproc://wake")
        self._wake_sender.connect("inproc://wake")
        self._lock = threading.Lock()
        self._outbox: deque[tuple[bytes, bytes]] = deque()
        self._waiting: dict[bytes, Future[Reply]] = {}
        self._numbers = itertools.count(1)
        #: Number of the last request that was sent.
        self._last_sent = b"0"
        self._ending = self._heartbeat_refused = False
        #: Time of the last message of the server, monotonic seconds.
        self.last_message_s = 0.0
        self._thread = BackgroundThread("escape client", self._run)
        self._thread.start()

    def _socket(self, kind: int, address: str, keys: Keys | None) -> zmq.Socket[bytes]:
        socket = self._context.socket(kind)
        socket.setsockopt(zmq.LINGER, 200)
        socket.setsockopt(zmq.MAXMSGSIZE, _LARGEST)
        socket.setsockopt(zmq.RECONNECT_IVL, 100)
        socket.setsockopt(zmq.RECONNECT_IVL_MAX, 1000)
        if kind == zmq.DEALER:
            # Identifies the connection, also after a reconnection; unknown to other clients.
            socket.setsockopt(zmq.ROUTING_ID, b"c" + os.urandom(16))
        if keys is not None:
            socket.curve_serverkey, socket.curve_publickey, socket.curve_secretkey = keys
        socket.connect(address)
        return socket

    def send_request(self, message: Mapping[str, Any], timeout_s: float) -> Reply:
        """Send a request and wait for its reply.

        Raises
        ------
        ServerGone
            No reply in time.
        EscapeError
            The error of the server.
        """
        answer: Future[Reply] = Future()
        number = str(next(self._numbers)).encode()
        with self._lock:
            if self._ending:
                raise ServerGone("this connection is closed")
            self._waiting[number] = answer
            self._outbox.append((number, json.dumps(message).encode()))
            self._wake_sender.send(b"")
        try:
            return answer.result(timeout_s)
        except FutureTimeoutError:
            raise ServerGone(
                f"no reply to '{message.get('verb')}' within {timeout_s:g} s; check that the server runs"
            ) from None
        finally:
            with self._lock:
                self._waiting.pop(number, None)

    def close(self) -> None:
        """Close the connection; waiting callers get ``ServerGone``."""
        with self._lock:
            if self._ending:
                return
            self._ending = True
            self._wake_sender.send(b"")
        self._thread.join(timeout=5)
        with self._lock:
            waiting, self._waiting = list(self._waiting.values()), {}
        for answer in waiting:
            answer.set_exception(ServerGone("this connection is closed"))
        for socket in (self._requests, self._events, self._wake_receiver, self._wake_sender):
            socket.close()
        self._context.term()

    def _run(self) -> None:
        poller = zmq.Poller()
        for socket in (self._requests, self._events, self._wake_receiver):
            poller.register(socket, zmq.POLLIN)
        last_heartbeat_s = 0.0
        while not self._ending:
            ready = dict(poller.poll(int(1000 * _HEARTBEAT_S)))
            if self._wake_receiver in ready:
                self._wake_receiver.recv()
            self._send_all()
            # Events first: one that was sent before a reply is handled before it.
            if self._events in ready:
                self._receive_events()
            if self._requests in ready:
                self._receive_reply()
            if time.monotonic() - last_heartbeat_s > _HEARTBEAT_S:
                refused, self._heartbeat_refused = self._heartbeat_refused, False
                if (message := self._heartbeat(refused)) is not None:
                    last_heartbeat_s = time.monotonic()
                    self._send(_HEARTBEAT + self._last_sent, json.dumps(message).encode())

    def _send_all(self) -> None:
        while True:
            with self._lock:
                if not self._outbox:
                    return
                number, text = self._outbox.popleft()
            self._send(number, text)
            self._last_sent = number

    def _send(self, number: bytes, text: bytes) -> None:
        try:
            self._requests.send_multipart([number, text], zmq.NOBLOCK)
        except zmq.Again:
            log.debug("the server accepts no messages; request %s is dropped", number)

    def _receive_reply(self) -> None:
        parts = self._requests.recv_multipart()
        self.last_message_s = time.monotonic()
        with self._lock:
            answer = self._waiting.pop(parts[0], None)
        if answer is None and not parts[0].startswith(_HEARTBEAT):
            return
        try:
            reply = json.loads(parts[1])
            if answer is None:
                self._heartbeat_refused = not reply["ok"]
                if reply["ok"]:
                    self._on_heartbeat_answer(reply["answer"])
                elif isinstance(error_from_document(reply["error"]), ClientUnknown):
                    self._fail_requests(int(parts[0].removeprefix(_HEARTBEAT)))
                return
            if reply["ok"]:
                data = parts[2] if len(parts) > 2 else b""
                answer.set_result((reply["answer"], data, int(reply.get("serial", 0))))
            else:
                answer.set_exception(error_from_document(reply["error"]))
        except (IndexError, KeyError, TypeError, ValueError) as error:
            invalid_reply = ServerGone(f"malformed reply of the server: {error!r}")
            if answer is None:
                log.warning("%s", invalid_reply)
            else:
                answer.set_exception(invalid_reply)

    def _fail_requests(self, last: int) -> None:
        """End the wait for requests that a server took with it when it ended: those before a heartbeat.

        The server that refused the heartbeat does not know this client. It has replied to what reached it
        before the heartbeat; ``last`` is the number of the last of them.
        """
        with self._lock:
            lost = [self._waiting.pop(number) for number in list(self._waiting) if int(number) <= last]
        for answer in lost:
            answer.set_exception(ServerGone(_LOST_TEXT))

    def _receive_events(self) -> None:
        while True:
            try:
                self._handle_event(self._events.recv_multipart(zmq.NOBLOCK))
            except zmq.Again:
                return

    def _handle_event(self, parts: list[bytes]) -> None:
        self.last_message_s = time.monotonic()
        try:
            self._on_event(parts[0].decode(), json.loads(parts[1]))
        except Exception as error:
            # A malformed event must not end the connection.
            log.warning("malformed event: %s: %s", type(error).__name__, error)
