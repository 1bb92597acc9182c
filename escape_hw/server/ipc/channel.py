"""JSON messages between the front end and the engine over a socket pair, and the engine's start-up settings. No pickle."""

from __future__ import annotations

import contextlib
import json
import logging
import queue
import socket
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict

from escape_hw.io.documents import to_plain_values


class EngineSetup(BaseModel):
    """An engine's orders, sent by the front as the first message.

    Parameters
    ----------
    config_text
        The system's whole configuration, TOML.
    runs
        Folder under which runs go.
    reads
        Folders that products may be loaded from.
    first_run
        Number of the first run.
    silence_s
        When the front was silent for so long, the mirror is made safe.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    config_text: str
    runs: Path
    reads: tuple[Path, ...]
    first_run: int = 1
    silence_s: float = 15.0


log = logging.getLogger(__name__)

#: The most that may wait for a reader that is slow; older messages give way.
_MAX_QUEUED = 1000
#: A line longer than this is no message.
_MAX_LINE_BYTES = 16 << 20


def encode(message: Mapping[str, Any]) -> bytes:
    """A message as a line."""
    return json.dumps(to_plain_values(message), separators=(",", ":"), allow_nan=False).encode() + b"\n"


class MessageDecoder:
    """Cuts a stream of bytes into messages.

    Raises
    ------
    ValueError
        What came is no message.
    """

    def __init__(self) -> None:
        self._incomplete = b""

    def feed(self, data: bytes) -> Iterator[dict[str, Any]]:
        """The messages that are complete with these bytes."""
        *lines, self._incomplete = (self._incomplete + data).split(b"\n")
        if len(self._incomplete) > _MAX_LINE_BYTES:
            raise ValueError(f"a message of more than {_MAX_LINE_BYTES} bytes")
        for line in lines:
            yield json.loads(line)


class Channel:
    """The engine's end: messages are handed over at once and sent by a thread, so that no loop waits.

    Parameters
    ----------
    connection
        A connected socket.
    """

    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection
        self._queue: queue.Queue[bytes | None] = queue.Queue(_MAX_QUEUED)
        self.dropped = 0
        self._sender = threading.Thread(target=self._send, name="sender", daemon=True)
        self._sender.start()

    def post(self, message: Mapping[str, Any]) -> None:
        """Hand a message over; it is dropped, and counted, when the reader is too slow."""
        try:
            self._queue.put_nowait(encode(message))
        except queue.Full:
            self.dropped += 1

    def messages(self) -> Iterator[dict[str, Any]]:
        """What arrives, until the other side hangs up."""
        lines = MessageDecoder()
        while True:
            try:
                data = self._connection.recv(65536)
            except OSError as error:
                log.warning("the channel failed: %s", error)
                return
            if not data:
                return
            yield from lines.feed(data)

    @property
    def has_unread(self) -> bool:
        """Whether something has arrived that nobody took yet; the end of it does not count."""
        try:
            return bool(self._connection.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT))
        except OSError:
            return False

    def close(self) -> None:
        """Send what waits, and hang up."""
        with contextlib.suppress(queue.Full):
            self._queue.put(None, timeout=1)
        self._sender.join(timeout=2)
        with contextlib.suppress(OSError):
            # A reader of the same socket waits in recv, which closing alone does not end.
            self._connection.shutdown(socket.SHUT_RDWR)
        self._connection.close()

    def _send(self) -> None:
        while (line := self._queue.get()) is not None:
            try:
                self._connection.sendall(line)
            except OSError:
                # The reader has gone; the engine learns it from the end of what it reads.
                return
