"""Connection to a server that fetches and reconnects in a thread, and a server started by the window."""

from __future__ import annotations

import logging
import os
import queue
import signal
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from typing import IO

from PySide6.QtCore import QObject, Signal

from escape_hw.errors import EscapeError
from escape_hw.io.night_log import NightEntry
from escape_hw.remote.address import find_server
from escape_hw.remote.client import Connection, connect
from escape_hw.remote.source import Sample
from escape_hw.remote.state import Geometry, LogLine, ProcedureEntry, State
from escape_hw.supervision import ChildProcess

log = logging.getLogger(__name__)
#: Name of windows, for the other clients.
CLIENT_NAME = "escape gui"
#: Period of the thread for a local and a remote server, interval between connection attempts, and time for
#: which a stream is fetched after the last request for it; seconds.
_LOCAL_PERIOD_S, _REMOTE_PERIOD_S, _RETRY_S, _STREAM_EXPIRY_S = 0.2, 0.02, 1.0, 1.0
#: A connection without a message for this time is replaced, seconds.
_RECONNECT_AFTER_S = 5.0
#: A wait that exceeds the requested time by this much means that this process was suspended, seconds.
_SUSPEND_DETECT_S = 2.0


class LiveSource:
    """A server as non-blocking :class:`~escape_hw.remote.source.DataSource`.

    Slow requests (geometry, procedures, streams of a remote server) are made by :meth:`fetch` in a thread;
    the other methods return the last result.
    The streams of a local server are read from shared memory (``is_local``).
    """

    def __init__(self, connection: Connection, *, is_local: bool) -> None:
        self.connection, self.is_local = connection, is_local
        self._geometry = Geometry()
        self._procedures: tuple[ProcedureEntry, ...] = ()
        self._requested_s: dict[str, float] = {}
        self._fetched: dict[str, Sample] = {}

    @property
    def connected(self) -> bool:
        return self.connection.connected

    @property
    def state(self) -> State:
        return self.connection.state

    def latest(self, stream: str, after: int = -1) -> Sample | None:
        """Newest entry of a stream unless its index is ``after``; for a remote server, the last fetched."""
        if self.is_local:
            return self.connection.latest(stream, after)
        self._requested_s[stream] = time.monotonic()
        sample = self._fetched.get(stream)
        return None if sample is None or sample.index == after else sample

    def geometry(self) -> Geometry:
        """Geometry; the same object until it changes."""
        return self._geometry

    def log_after(self, number: int) -> Sequence[LogLine]:
        return self.connection.log_after(number)

    def night_after(self, number: int) -> Sequence[NightEntry]:
        return self.connection.night_after(number)

    def procedures(self) -> Sequence[ProcedureEntry]:
        """Available procedures; empty until they were fetched."""
        return self._procedures

    def fetch(self) -> None:
        """Make the slow requests; called by the thread of :class:`ServerAttachment`."""
        if (geometry := self.connection.geometry()) != self._geometry:
            self._geometry = geometry
        if not self._procedures:
            self._procedures = tuple(self.connection.procedures())
        if self.is_local:
            return
        now = time.monotonic()
        for stream, requested_s in list(self._requested_s.items()):
            if now - requested_s > _STREAM_EXPIRY_S:
                del self._requested_s[stream]
                continue
            known = self._fetched.get(stream)
            sample = self.connection.latest(stream, -1 if known is None else known.index)
            if sample is not None:
                self._fetched[stream] = sample


class ServerAttachment(QObject):
    """Connects to a server, and reconnects when it is lost, in a thread.

    The address is the name of a system served on this computer, or ``tcp://host:port``.
    """

    #: A new connection, as :class:`LiveSource`.
    attached = Signal(object)
    #: Why an attempt to connect failed.
    connection_failed = Signal(str)

    def __init__(self, address: str) -> None:
        super().__init__()
        self.address = address
        self._is_local = "://" not in address
        self._jobs: queue.Queue[Callable[[], None]] = queue.Queue()
        self._stop = threading.Event()
        self._live: LiveSource | None = None
        self._last_heard_s = 0.0
        self._thread = threading.Thread(target=self._run_loop, name="escape-gui-attachment", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def discard(self, old: LiveSource) -> None:
        self._jobs.put(old.connection.close)

    @property
    def live(self) -> LiveSource | None:
        """The newest connection."""
        return self._live

    def stop(self) -> None:
        """Ask the thread to disconnect and end; the source must not be used afterwards."""
        self._stop.set()
        self._jobs.put(lambda: None)

    def close(self) -> None:
        """Stop the thread and disconnect; the source must not be used afterwards."""
        self.stop()
        if self._thread.is_alive():
            self._thread.join(timeout=10)

    def _run_loop(self) -> None:
        while not self._stop.is_set():
            try:
                self._check_connection()
            except EscapeError as error:
                self.connection_failed.emit(str(error))
            except Exception:
                log.exception("connection check failed")
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
        connection = connect(self.address, name=CLIENT_NAME)
        self._live = LiveSource(connection, is_local=self._is_local)
        self._last_heard_s = now
        self.attached.emit(self._live)

    def _same_server(self) -> bool:
        """Whether the process that serves the system is still the one of this connection."""
        if not self._is_local or self._live is None:
            return True
        listing = find_server(self.address)
        return listing is not None and listing.pid == self._live.state.server_pid

    def _wait_and_run_jobs(self) -> None:
        """Wait for one period, or run a job that arrives meanwhile."""
        pause = _RETRY_S if self._live is None else _LOCAL_PERIOD_S if self._is_local else _REMOTE_PERIOD_S
        began = time.monotonic()
        try:
            job = self._jobs.get(timeout=pause)
        except queue.Empty:
            now = time.monotonic()
            if now - began > pause + _SUSPEND_DETECT_S:
                # This process was suspended, not the server: unread messages are waiting.
                self._last_heard_s = now
            return
        try:
            job()
        except EscapeError as error:
            log.warning("a connection could not be closed: %s", error)


#: Time for a server to flatten the mirror and exit, seconds.
_EXIT_TIMEOUT_S = 20.0
_MAX_ERROR_LINES = 6


class LocalServer:
    """A process that serves a system (name or file) with simulated devices.

    It runs in its own process session: it survives if the window is killed, and the next window for the
    system attaches to it.
    """

    def __init__(self, system: str) -> None:
        # Closed by :meth:`terminate`, after the process has ended.
        self._stderr: IO[str] = tempfile.TemporaryFile("w+", encoding="utf-8")  # noqa: SIM115
        self.process = ChildProcess(
            "escape_hw.cli", "serve", system, "--mode", "sim", "--quiet",
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=self._stderr,
        )  # fmt: skip

    @property
    def exit_message(self) -> str:
        """Last lines on standard error of a process that has ended; empty while it runs."""
        code = self.process.wait(0)
        if code is None:
            return ""
        self._stderr.seek(0)
        lines = self._stderr.read().strip().splitlines()[-_MAX_ERROR_LINES:]
        return "\n".join(lines) or f"server exited with code {code}"

    def leave(self) -> None:
        """Let the server go on; the next window attaches to it."""
        log.warning("the server (process %d) keeps running", self.process.pid)
        self._stderr.close()

    def terminate(self, connection: Connection | None) -> None:
        """Shut the server down, by a signal (SIGINT) if there is no connection, and wait for it."""
        if self.process.running:
            try:
                if connection is None:
                    raise EscapeError("not connected")
                connection.acquire(take_over=True)
                connection.shutdown()
            except EscapeError as error:
                log.info("shutdown request failed (%s); sending SIGINT to the server", error)
                os.kill(self.process.pid, signal.SIGINT)
            if self.process.wait(_EXIT_TIMEOUT_S) is None:
                log.warning("server %d has not exited after %g s", self.process.pid, _EXIT_TIMEOUT_S)
        self._stderr.close()
