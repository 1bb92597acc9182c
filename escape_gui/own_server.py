"""A server that the window starts for itself, on the twin, and ends when it is closed."""

from __future__ import annotations

import logging
import signal
import subprocess
import sys
import tempfile
from typing import IO

from escape_hw.errors import EscapeError
from escape_hw.remote.client import Connection

log = logging.getLogger(__name__)
_SERVE = (sys.executable, "-c", "from escape_hw.cli import main; main()", "serve")
#: Seconds that a server may take to make its mirror flat and end.
_END_S = 20.0
_LAST_LINES = 6


class OwnServer:
    """A process that serves a system on its twin.

    It lives in a session of its own: killing the window does not disturb it, and the next window for the
    same system finds it again.

    Parameters
    ----------
    system
        Name or file of the configuration.
    """

    def __init__(self, system: str) -> None:
        # Open as long as the process lives, see :meth:`end`.
        self._words: IO[str] = tempfile.TemporaryFile("w+", encoding="utf-8")  # noqa: SIM115
        self.process = subprocess.Popen(
            [*_SERVE, system, "--mode", "sim", "--quiet"],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=self._words,
            start_new_session=True,
        )

    @property
    def failure(self) -> str:
        """The last it said before it ended by itself; empty while it runs."""
        if self.process.poll() is None:
            return ""
        self._words.seek(0)
        return "\n".join(self._words.read().strip().splitlines()[-_LAST_LINES:]) or "the server has ended"

    def end(self, connection: Connection | None) -> None:
        """Ask it to make the mirror safe and end, then wait; without a connection it gets Ctrl-C."""
        if self.process.poll() is None:
            try:
                if connection is None:
                    raise EscapeError("not connected")
                connection.acquire(take_over=True)
                connection.shutdown()
            except EscapeError as error:
                log.info("the server is interrupted instead of asked to end: %s", error)
                self.process.send_signal(signal.SIGINT)
            try:
                self.process.wait(_END_S)
            except subprocess.TimeoutExpired:
                log.warning("server %d has not ended; it is left alone", self.process.pid)
        self._words.close()
