"""The engine and its guardian as the front sees them: started, spoken to, watched, ended."""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from typing import Any

from escape_hw.server.channel import Lines, encode
from escape_hw.server.growing_pause import GrowingPause
from escape_hw.server.guardian import Watch
from escape_hw.server.setup import Setup
from escape_hw.streams.segments import process_start

log = logging.getLogger(__name__)

#: Seconds that an engine has to end in order: a partial result is saved meanwhile.
ENDING_S = 60.0
#: Seconds that an engine may be silent while its mirror is flat.
PATIENCE_S = 120.0
_ENGINE, _GUARDIAN = "escape_hw.server.engine", "escape_hw.server.guardian"


class EngineProcess:
    """A running engine with its guardian.

    Parameters
    ----------
    setup
        The engine's orders.
    incidents
        Folder in which the guardian writes what it did.

    Attributes
    ----------
    connection
        The front's end of the channel, for a poller.
    said_goodbye
        Whether the engine ended in order.
    heard
        When it last said something, monotonic seconds; when it was started, before its first word.
    """

    def __init__(self, setup: Setup, incidents: str) -> None:
        self.connection, theirs = socket.socketpair()
        self._watched, held = os.pipe()
        try:
            self._process = self._spawn(_ENGINE, (theirs.fileno(), held))
            started = process_start(self._process.pid) or 0
            self._watch = Watch(
                config_text=setup.config_text, incidents=incidents, pid=self._process.pid, started=started
            )
            self._guardian, self._pause = self._guard(), GrowingPause()
        finally:
            theirs.close()
            os.close(held)
        self._lines = Lines()
        self._unsent = b""
        self.said_goodbye = False
        self.heard = time.monotonic()
        self.send(setup.model_dump(mode="json"))
        self.connection.setblocking(False)

    @staticmethod
    def _spawn(module: str, descriptors: tuple[int, ...], **options: Any) -> subprocess.Popen[bytes]:
        # A session of its own: neither the terminal's Ctrl-C nor its end reaches it.
        return subprocess.Popen(
            [sys.executable, "-m", module, *map(str, descriptors)],
            pass_fds=descriptors, start_new_session=True, **options,
        )  # fmt: skip

    def _guard(self) -> subprocess.Popen[bytes]:
        guardian = self._spawn(_GUARDIAN, (self._watched,), stdin=subprocess.PIPE)
        if guardian.stdin is None:
            raise RuntimeError("the guardian has no standard input")
        guardian.stdin.write(self._watch.model_dump_json().encode())
        guardian.stdin.close()
        return guardian

    def mind_guardian(self, alive: bool) -> None:
        """Have another guardian at the same pipe where the one before was killed and the engine goes on.

        To be called every second. One that dies at once, or cannot be started, is tried again after a
        pause that grows.

        Parameters
        ----------
        alive
            Whether there was a guardian, when the engine was last seen alive.
        """
        if alive:
            self._pause.lives()
            return
        if not self._pause.over():
            return
        pause = self._pause.start()
        log.error(
            "the guardian (process %d) died; another one takes its place, and the next not within %g s",
            self._guardian.pid, pause,
        )  # fmt: skip
        try:
            self._guardian = self._guard()
        except OSError as error:
            # Whatever killed the guardian, such as want of memory, must not end the server, too.
            log.error("no guardian could be started, which is tried again in %g s: %s", pause, error)

    @property
    def pid(self) -> int:
        """The engine's process."""
        return self._process.pid

    def send(self, message: Mapping[str, Any]) -> None:
        """Send a message without waiting: what the engine does not take now goes with the next one."""
        self._unsent += encode(message)
        self.flush()

    def flush(self) -> None:
        """Send what could not be sent before."""
        with contextlib.suppress(BlockingIOError, BrokenPipeError, ConnectionResetError):
            while self._unsent:
                self._unsent = self._unsent[self.connection.send(self._unsent) :]

    def receive(self) -> Iterator[dict[str, Any]]:
        """What has arrived."""
        while True:
            try:
                data = self.connection.recv(1 << 18)
            except (BlockingIOError, ConnectionResetError):
                return
            if not data:
                return
            self.heard = time.monotonic()
            for message in self._lines.feed(data):
                self.said_goodbye = self.said_goodbye or "goodbye" in message
                yield message

    def ended(self) -> bool:
        """Whether the engine's process is gone."""
        return self._process.poll() is not None

    def guarded(self) -> bool:
        """Whether the guardian is still there."""
        return self._guardian.poll() is None

    def hang_up(self) -> None:
        """Say no more; an engine that notices it stops, the mirror flat."""
        with contextlib.suppress(OSError):
            self.connection.shutdown(socket.SHUT_WR)

    def kill(self) -> None:
        """End an engine that does not answer any more; the guardian does the rest."""
        with contextlib.suppress(ProcessLookupError):
            os.kill(self._process.pid, signal.SIGCONT)
        self._process.kill()

    def close(self) -> bool:
        """Wait for both to end; true when the engine ended in order."""
        try:
            self._process.wait(ENDING_S)
        except subprocess.TimeoutExpired:
            log.error("the engine did not end within %g s; it is killed", ENDING_S)
            self.kill()
            self._process.wait()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._guardian.wait(ENDING_S)
        os.close(self._watched)
        list(self.receive())
        self.connection.close()
        return self.said_goodbye
