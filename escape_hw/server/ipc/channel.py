"""JSON messages between the front end and the engine over a socket pair, and the engine's start-up settings.

Front end to engine: the settings, then ``{"heartbeat": true}``, ``{"id": N, "request": {...}}``,
``{"make_safe": {"reason": ..., "remedy": ...}}``, ``{"stop": true}``. Engine to front end: ``{"reply": N,
"answer": ...}`` or ``{"reply": N, "error": ...}``, and objects with the key ``state``, ``log``, ``progress``,
``run``, ``ended`` or ``clean_exit``.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import logging
import queue
import socket
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict

from escape_hw.io.documents import to_plain_values
from escape_hw.remote.state import ProductEntry
from escape_hw.supervision import BackgroundThread

log = logging.getLogger(__name__)

#: Messages that may wait for a slow reader; further states, progress and log lines of level INFO are dropped.
_MAX_QUEUED = 1000
#: Longest message.
_MAX_LINE_BYTES = 16 << 20


class EngineSetup(BaseModel):
    """Start-up settings of an engine, the first message from the front end."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    #: The system's configuration, TOML.
    config_text: str
    #: Parent of the run folders, and further folders that products may be loaded from.
    runs: Path
    read_folders: tuple[Path, ...]
    #: Number of the first run.
    first_run_id: int = 1
    #: Products that requests may name, of the engine before.
    products: tuple[ProductEntry, ...] = ()
    #: Silence of the front end after which the mirror is made safe.
    front_end_timeout_s: float = 15.0


def encode(message: Mapping[str, Any]) -> bytes:
    """Encode a message as one line of JSON."""
    return json.dumps(to_plain_values(message), separators=(",", ":"), allow_nan=False).encode() + b"\n"


class MessageDecoder:
    """Splits a stream of bytes into messages."""

    def __init__(self) -> None:
        self._incomplete = b""

    def feed(self, data: bytes) -> Iterator[dict[str, Any]]:
        """Yield the messages that these bytes complete (ValueError: A line is too long or no JSON)."""
        *lines, self._incomplete = (self._incomplete + data).split(b"\n")
        if len(self._incomplete) > _MAX_LINE_BYTES:
            raise ValueError(f"a message of more than {_MAX_LINE_BYTES} bytes")
        for line in lines:
            yield json.loads(line)


def _is_droppable(message: Mapping[str, Any]) -> bool:
    match message:
        case {"state": _} | {"progress": _} | {"log": {"level": "INFO"}}:
            return True
    return False


class Channel:
    """The engine's end of the connection. A thread sends the messages, so that no caller waits."""

    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection
        self._queue: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        self._dropped = itertools.count(1)
        self._last_message_s = time.monotonic()
        self._sender = BackgroundThread("sender", self._send)
        self._sender.start()

    def post(self, message: Mapping[str, Any]) -> None:
        """Queue a message; a state, progress or log line is dropped when the front end reads too slowly."""
        if self._queue.qsize() < _MAX_QUEUED or not _is_droppable(message):
            self._queue.put(encode(message))
            return
        dropped = next(self._dropped)
        if dropped & (dropped - 1) == 0:  # log the 1st, 2nd, 4th, 8th ... only
            log.warning("the front end reads too slowly; %d messages were dropped so far", dropped)

    def messages(self) -> Iterator[dict[str, Any]]:
        """Yield the messages that arrive, until the other side closes the connection."""
        decoder = MessageDecoder()
        while True:
            try:
                data = self._connection.recv(65536)
            except OSError as error:
                log.warning("the channel failed: %s", error)
                return
            if not data:
                return
            self._last_message_s = time.monotonic()
            yield from decoder.feed(data)

    @property
    def has_unread(self) -> bool:
        """Whether a message has arrived that was not read yet; the end of the connection is none."""
        try:
            return bool(self._connection.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT))
        except OSError:
            return False

    @property
    def silence_s(self) -> float:
        """Seconds since the last message; 0 while one is unread, since the reader is late then."""
        return 0.0 if self.has_unread else time.monotonic() - self._last_message_s

    def close(self) -> None:
        """Send the queued messages and close the connection."""
        self._queue.put(None)
        self._sender.stop(timeout_s=2)
        with contextlib.suppress(OSError):
            # A thread that waits in recv is not woken by close() alone.
            self._connection.shutdown(socket.SHUT_RDWR)
        self._connection.close()

    def _send(self) -> None:
        while (line := self._queue.get()) is not None:
            try:
                self._connection.sendall(line)
            except OSError:
                # The front end is gone; messages() ends as well.
                return
