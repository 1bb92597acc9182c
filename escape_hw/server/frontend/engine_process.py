"""The engine process and its fail-safe process: start, messages, liveness and end."""

from __future__ import annotations

import contextlib
import logging
import os
import socket
import subprocess
import time
from collections.abc import Iterator, Mapping
from typing import Any

from escape_hw.server.ipc.channel import EngineSetup, MessageDecoder, encode
from escape_hw.server.safety.failsafe import FailsafeSettings
from escape_hw.supervision import Backoff, ChildProcess, process_start

log = logging.getLogger(__name__)

#: Seconds that an engine may take to end; it saves a partial result meanwhile.
STOP_TIMEOUT_S = 60.0
_ENGINE, _FAILSAFE = "escape_hw.server.engine.main", "escape_hw.server.safety.failsafe"


class EngineProcess:
    """A running engine with its fail-safe process.

    Attributes
    ----------
    process, failsafe
        The engine's process, and the fail-safe process.
    connection
        The front end's end of the channel, for a poller.
    ended_cleanly
        Whether the engine has sent that it ended with a flat mirror.
    last_message_s
        Time of the last message, or of the start before the first; monotonic seconds.
    """

    def __init__(self, setup: EngineSetup, incidents: str) -> None:
        self.connection, engine_end = socket.socketpair()
        self._pipe_end, held_end = os.pipe()
        try:
            descriptors = (engine_end.fileno(), held_end)
            self.process = ChildProcess(_ENGINE, *map(str, descriptors), pass_fds=descriptors)
            self._failsafe_settings = FailsafeSettings(
                config_text=setup.config_text, incidents=incidents, pid=self.process.pid,
                started=process_start(self.process.pid) or 0,
            )  # fmt: skip
            self.failsafe, self._backoff = self._start_failsafe(), Backoff()
        finally:
            engine_end.close()
            os.close(held_end)
        self._decoder = MessageDecoder()
        self._unsent = b""
        self.ended_cleanly = False
        self.last_message_s = time.monotonic()
        self.send(setup.model_dump(mode="json"))
        self.connection.setblocking(False)

    def _start_failsafe(self) -> ChildProcess:
        pipe = self._pipe_end
        failsafe = ChildProcess(_FAILSAFE, str(pipe), pass_fds=(pipe,), stdin=subprocess.PIPE)
        failsafe.stdin.write(self._failsafe_settings.model_dump_json().encode())
        failsafe.stdin.close()
        return failsafe

    def maintain_failsafe(self, alive: bool) -> None:
        """Restart the fail-safe process after it died; call this every second.

        The delay between restarts grows while the process dies at once or cannot be started. ``alive`` is
        whether it ran when the engine was last seen running.
        """
        if alive:
            self._backoff.mark_alive()
            return
        if not self._backoff.is_over():
            return
        pause = self._backoff.begin_attempt()
        log.error(
            "the fail-safe process (%d) died; it is restarted, and not again within %g s",
            self.failsafe.pid, pause,
        )  # fmt: skip
        try:
            self.failsafe = self._start_failsafe()
        except OSError as error:
            # Lack of memory, for example, must not end the server as well.
            log.error("the fail-safe process cannot be started; next attempt in %g s: %s", pause, error)

    def send(self, message: Mapping[str, Any]) -> None:
        """Send a message without waiting; what the engine does not accept now is sent later."""
        self._unsent += encode(message)
        self.flush()

    def flush(self) -> None:
        """Send what could not be sent before."""
        with contextlib.suppress(BlockingIOError, BrokenPipeError, ConnectionResetError):
            while self._unsent:
                self._unsent = self._unsent[self.connection.send(self._unsent) :]

    def receive(self) -> Iterator[dict[str, Any]]:
        """Yield the messages that have arrived."""
        while True:
            try:
                data = self.connection.recv(1 << 18)
            except (BlockingIOError, ConnectionResetError):
                return
            if not data:
                return
            self.last_message_s = time.monotonic()
            for message in self._decoder.feed(data):
                self.ended_cleanly = self.ended_cleanly or "clean_exit" in message
                yield message

    def close_channel(self) -> None:
        """Close the sending direction; the engine then stops with a flat mirror."""
        with contextlib.suppress(OSError):
            self.connection.shutdown(socket.SHUT_WR)

    def close(self) -> bool:
        """Wait for both processes to end; true when the engine ended with a flat mirror."""
        if not self.process.wait_or_kill(STOP_TIMEOUT_S):
            log.error("the engine did not end within %g s and was killed", STOP_TIMEOUT_S)
        self.failsafe.wait(STOP_TIMEOUT_S)
        os.close(self._pipe_end)
        list(self.receive())
        self.connection.close()
        return self.ended_cleanly
