"""A server as panels see it: what takes time is fetched by a thread, and a lost server is found again."""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Callable, Sequence

from PySide6.QtCore import QObject, Signal

from escape_hw.errors import EscapeError
from escape_hw.remote.address import find_listing
from escape_hw.remote.client import Connection, connect
from escape_hw.remote.source import Sample
from escape_hw.remote.state import Arguments, Geometry, LogLine, Plan, ProcedureEntry, State

log = logging.getLogger(__name__)
#: Pauses of the thread: between looks at a server on this machine or another one, between attempts to
#: find one, and how long a stream is fetched that no panel asks for any more; seconds.
_HERE_S, _AFAR_S, _RETRY_S, _FORGET_S = 0.2, 0.02, 1.0, 1.0
#: A connection that was silent for so long is made anew, seconds.
_DEAD_S = 5.0
#: A wait that was longer than asked by so much was a halt of this process, seconds.
_HALTED_S = 2.0


class LiveSource:
    """A connection whose every word is at hand; satisfies :class:`~escape_hw.remote.source.Source`.

    Parameters
    ----------
    connection
        To the server.
    here
        The server runs on this machine, and its streams lie in shared memory.
    """

    def __init__(self, connection: Connection, *, here: bool) -> None:
        self.connection, self.here = connection, here
        self._places = Geometry()
        self._offers: tuple[ProcedureEntry, ...] = ()
        self._wanted: dict[str, float] = {}
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
        if self.here:
            return self.connection.latest(stream, after)
        self._wanted[stream] = time.monotonic()
        sample = self._fetched.get(stream)
        return None if sample is None or sample.index == after else sample

    def geometry(self) -> Geometry:
        """Where things stand; the same object as long as nothing has changed."""
        return self._places

    def log_after(self, number: int) -> Sequence[LogLine]:
        """Log lines after a number."""
        return self.connection.log_after(number)

    def procedures(self) -> Sequence[ProcedureEntry]:
        """What can be started, once that has arrived."""
        return self._offers

    def check(self, procedure: str, arguments: Arguments) -> Plan:
        """Ask the server; waits for the answer."""
        return self.connection.check(procedure, arguments)

    def fetch(self) -> None:
        """Fetch what takes time; called by the thread only."""
        places = self.connection.geometry()
        if places != self._places:
            self._places = places
        if not self._offers:
            self._offers = tuple(self.connection.procedures())
        if self.here:
            return
        now = time.monotonic()
        for stream, asked in list(self._wanted.items()):
            if now - asked > _FORGET_S:
                del self._wanted[stream]
                continue
            known = self._fetched.get(stream)
            sample = self.connection.latest(stream, -1 if known is None else known.index)
            if sample is not None:
                self._fetched[stream] = sample


class Attachment(QObject):
    """Keeps a window attached to a server, in a thread of its own.

    Parameters
    ----------
    address
        Name of a system served on this machine, or ``tcp://host:port``.
    """

    #: A new connection, as :class:`LiveSource`; after the first one the server had been away.
    attached = Signal(object)
    #: Why there is none; told once for each reason.
    failing = Signal(str)

    def __init__(self, address: str) -> None:
        super().__init__()
        self.address = address
        self._here = "://" not in address
        self._jobs: queue.Queue[Callable[[], None]] = queue.Queue()
        self._stop = threading.Event()
        self._live: LiveSource | None = None
        self._told = ""
        self._heard = 0.0
        self._thread = threading.Thread(target=self._run, name="escape-gui-attachment", daemon=True)

    def start(self) -> None:
        """Begin to look for the server."""
        self._thread.start()

    def drop(self, old: LiveSource) -> None:
        """Close a connection that no panel looks at any more."""
        self._jobs.put(old.connection.close)

    def close(self) -> None:
        """Hang up; nobody may look at the source any more."""
        self._stop.set()
        self._jobs.put(lambda: None)
        if self._thread.is_alive():
            self._thread.join(timeout=10)

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                self._look()
            except EscapeError as error:
                self._tell(str(error))
            except Exception:
                log.exception("looking after the server failed")
            self._work()
        if self._live is not None:
            self._live.connection.close()

    def _look(self) -> None:
        now = time.monotonic()
        live = self._live
        if live is not None and live.connected:
            self._heard = now
            live.fetch()
            return
        if live is not None and now - self._heard < _DEAD_S and self._same_server():
            return
        connection = connect(self.address, name="escape gui")
        self._live = LiveSource(connection, here=self._here)
        self._heard, self._told = now, ""
        self.attached.emit(self._live)

    def _same_server(self) -> bool:
        """Whether the server that fell silent is still the one to be found under the address."""
        if not self._here or self._live is None:
            return True
        listing = find_listing(self.address)
        return listing is not None and listing.pid == self._live.state.server_pid

    def _tell(self, reason: str) -> None:
        if reason != self._told:
            self._told = reason
            self.failing.emit(reason)

    def _work(self) -> None:
        """Wait for the next look; close what is to be closed meanwhile."""
        pause = _RETRY_S if self._live is None else _HERE_S if self._here else _AFAR_S
        began = time.monotonic()
        try:
            job = self._jobs.get(timeout=pause)
        except queue.Empty:
            now = time.monotonic()
            if now - began > pause + _HALTED_S:
                # This process slept, not the server: what has come meanwhile is still to be read.
                self._heard = now
            return
        try:
            job()
        except EscapeError as error:
            log.warning("a connection could not be closed: %s", error)
