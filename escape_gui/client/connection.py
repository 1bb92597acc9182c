"""Connection to a server with background fetching and reconnection, and a server process started by the window."""

from __future__ import annotations

import logging
import queue
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from typing import IO

from PySide6.QtCore import QObject, Signal

from escape_hw.errors import EscapeError
from escape_hw.remote.address import find_server
from escape_hw.remote.client import Connection, connect
from escape_hw.remote.source import Sample
from escape_hw.remote.state import Arguments, Geometry, LogLine, ProcedureEntry, ProcedurePlan, State

log = logging.getLogger(__name__)
#: Pauses of the thread: between looks at a server on this machine or another one, between attempts to
#: find one, and how long a stream is fetched that no panel asks for any more; seconds.
_LOCAL_PERIOD_S, _REMOTE_PERIOD_S, _RETRY_S, _STREAM_EXPIRY_S = 0.2, 0.02, 1.0, 1.0
#: A connection that was silent for so long is made anew, seconds.
_RECONNECT_AFTER_S = 5.0
#: A wait that was longer than asked by so much was a halt of this process, seconds.
_SUSPEND_DETECT_S = 2.0


class LiveSource:
    """A connection whose every word is at hand; satisfies :class:`~escape_hw.remote.source.Source`.

    Parameters
    ----------
    connection
        To the server.
    here
        The server runs on this machine, and its streams lie in shared memory.
    """

    def __init__(self, connection: Connection, *, is_local: bool) -> None:
        self.connection, self.is_local = connection, is_local
        self._geometry = Geometry()
        self._procedures: tuple[ProcedureEntry, ...] = ()
        self._requested_s: dict[str, float] = {}
        self._fetched: dict[str, Sample] = {}

    @property
    def connected(self) -> bool:
        """Whether the server was heard of lately."""
        return self.connection.connected

    @property
    def state(self) -> State:
        """The newest state."""
        return self.connection.state

    def latest(self, stream: str, after: int = -1) -> Sample | None:
        """The newest entry of a stream; from another machine, the newest that has arrived."""
        if self.is_local:
            return self.connection.latest(stream, after)
        self._requested_s[stream] = time.monotonic()
        sample = self._fetched.get(stream)
        return None if sample is None or sample.index == after else sample

    def geometry(self) -> Geometry:
        """Where things stand; the same object as long as nothing has changed."""
        return self._geometry

    def log_after(self, number: int) -> Sequence[LogLine]:
        """Log lines after a number."""
        return self.connection.log_after(number)

    def procedures(self) -> Sequence[ProcedureEntry]:
        """What can be started, once that has arrived."""
        return self._procedures

    def plan(self, procedure: str, arguments: Arguments) -> ProcedurePlan:
        """Ask the server; waits for the answer."""
        return self.connection.plan(procedure, arguments)

    def fetch(self) -> None:
        """Fetch what takes time; called by the thread only."""
        places = self.connection.geometry()
        if places != self._geometry:
            self._geometry = places
        if not self._procedures:
            self._procedures = tuple(self.connection.procedures())
        if self.is_local:
            return
        now = time.monotonic()
        for stream, asked in list(self._requested_s.items()):
            if now - asked > _STREAM_EXPIRY_S:
                del self._requested_s[stream]
                continue
            known = self._fetched.get(stream)
            sample = self.connection.latest(stream, -1 if known is None else known.index)
            if sample is not None:
                self._fetched[stream] = sample


class ServerAttachment(QObject):
    """Keeps a window attached to a server, in a thread of its own.

    Parameters
    ----------
    address
        Name of a system served on this machine, or ``tcp://host:port``.
    """

    #: A new connection, as :class:`LiveSource`; after the first one the server had been away.
    attached = Signal(object)
    #: Why there is none; told once for each reason.
    connection_failed = Signal(str)

    def __init__(self, address: str) -> None:
        super().__init__()
        self.address = address
        self._is_local = "://" not in address
        self._jobs: queue.Queue[Callable[[], None]] = queue.Queue()
        self._stop = threading.Event()
        self._live: LiveSource | None = None
        self._last_failure = ""
        self._last_heard_s = 0.0
        self._thread = threading.Thread(target=self._run_loop, name="escape-gui-attachment", daemon=True)

    def start(self) -> None:
        """Begin to look for the server."""
        self._thread.start()

    def discard(self, old: LiveSource) -> None:
        """Close a connection that no panel looks at any more."""
        self._jobs.put(old.connection.close)

    def close(self) -> None:
        """Hang up; nobody may look at the source any more."""
        self._stop.set()
        self._jobs.put(lambda: None)
        if self._thread.is_alive():
            self._thread.join(timeout=10)

    def _run_loop(self) -> None:
        while not self._stop.is_set():
            try:
                self._check_connection()
            except EscapeError as error:
                self._report_failure(str(error))
            except Exception:
                log.exception("looking after the server failed")
            self._wait_and_run_jobs()
        if self._live is not None:
            self._live.connection.close()

    def _check_connection(self) -> None:
        now = time.monotonic()
        live = self._live
        if live is not None and live.connected:
            self._last_heard_s = now
            live.fetch()
            return
        if live is not None and now - self._last_heard_s < _RECONNECT_AFTER_S and self._same_server():
            return
        connection = connect(self.address, name="escape gui")
        self._live = LiveSource(connection, is_local=self._is_local)
        self._last_heard_s, self._last_failure = now, ""
        self.attached.emit(self._live)

    def _same_server(self) -> bool:
        """Whether the server that fell silent is still the one to be found under the address."""
        if not self._is_local or self._live is None:
            return True
        listing = find_server(self.address)
        return listing is not None and listing.pid == self._live.state.server_pid

    def _report_failure(self, reason: str) -> None:
        if reason != self._last_failure:
            self._last_failure = reason
            self.connection_failed.emit(reason)

    def _wait_and_run_jobs(self) -> None:
        """Wait for the next look; close what is to be closed meanwhile."""
        pause = _RETRY_S if self._live is None else _LOCAL_PERIOD_S if self._is_local else _REMOTE_PERIOD_S
        began = time.monotonic()
        try:
            job = self._jobs.get(timeout=pause)
        except queue.Empty:
            now = time.monotonic()
            if now - began > pause + _SUSPEND_DETECT_S:
                # This process slept, not the server: what has come meanwhile is still to be read.
                self._last_heard_s = now
            return
        try:
            job()
        except EscapeError as error:
            log.warning("a connection could not be closed: %s", error)


_SERVE_COMMAND = (sys.executable, "-c", "from escape_hw.cli import main; main()", "serve")
#: Seconds that a server may take to make its mirror flat and end.
_EXIT_TIMEOUT_S = 20.0
_MAX_ERROR_LINES = 6


class LocalServer:
    """A process that serves a system on its twin.

    It lives in a session of its own: killing the window does not disturb it, and the next window for the
    same system finds it again.

    Parameters
    ----------
    system
        Name or file of the configuration.
    """

    def __init__(self, system: str) -> None:
        # Open as long as the process lives, see :meth:`terminate`.
        self._stderr: IO[str] = tempfile.TemporaryFile("w+", encoding="utf-8")
        self.process = subprocess.Popen(
            [*_SERVE_COMMAND, system, "--mode", "sim", "--quiet"],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=self._stderr,
            start_new_session=True,
        )

    @property
    def exit_message(self) -> str:
        """The last it said before it ended by itself; empty while it runs."""
        if self.process.poll() is None:
            return ""
        self._stderr.seek(0)
        return (
            "\n".join(self._stderr.read().strip().splitlines()[-_MAX_ERROR_LINES:]) or "the server has ended"
        )

    def terminate(self, connection: Connection | None) -> None:
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
                self.process.wait(_EXIT_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                log.warning("server %d has not ended; it is left alone", self.process.pid)
        self._stderr.close()
