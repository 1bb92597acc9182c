"""Session: the data source of a window and the sender of its requests; neither blocks the window's thread."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import TypeVar

from PySide6.QtCore import QObject, Qt, Signal

from escape_gui.client.availability import RequestContext
from escape_gui.client.history import LoopHistory
from escape_gui.client.product_library import ProductLibrary
from escape_hw.errors import EscapeError, ServerGone
from escape_hw.io.night_log import NightEntry
from escape_hw.io.run_folder import default_runs_folder
from escape_hw.remote.client import Connection
from escape_hw.remote.source import DataSource, Sample
from escape_hw.remote.state import Geometry, LogLine, ProcedureEntry, State

log = logging.getLogger(__name__)
#: Why a request failed whose connection was replaced meanwhile.
_REPLACED = "the server did not answer on the previous connection; look at the state, and repeat if necessary"
T = TypeVar("T")


class EmptySource:
    """Source without data, shown before a window is connected."""

    connected = False
    state = State()
    _geometry = Geometry()

    def latest(self, stream: str, after: int = -1) -> Sample | None:
        return None

    def geometry(self) -> Geometry:
        return self._geometry

    def log_after(self, number: int) -> Sequence[LogLine]:
        return ()

    def night_after(self, number: int) -> Sequence[NightEntry]:
        return ()

    def procedures(self) -> Sequence[ProcedureEntry]:
        return ()


class Session(QObject):
    """Data source of a window and sender of its requests; both change when another source is opened.

    Worker threads send the requests, and the answers are delivered in the window's thread. Safety requests
    have a thread of their own, so that none waits for a slow request.
    """

    #: The source was replaced; panels clear their content.
    changed = Signal()
    #: Name of a request, and why it failed.
    failed = Signal(str, str)
    #: Number of requests without an answer.
    pending_changed = Signal(int)
    _delivered = Signal(object)

    def __init__(self) -> None:
        super().__init__()
        self.source: DataSource = EmptySource()
        #: Receives the requests; ``None`` in replay and before a connection.
        self.control: Connection | None = None
        #: Strehl ratio and residual over hours.
        self.history = LoopHistory()
        #: Products listed by the source, loaded for the panels.
        self.library = ProductLibrary()
        self._executors: dict[bool, ThreadPoolExecutor] = {}
        #: Those of earlier connections, whose last requests may still wait for a reply.
        self._ended_executors: list[ThreadPoolExecutor] = []
        self._pending = 0
        self._computing: ThreadPoolExecutor | None = None
        self._closed = False
        self._delivered.connect(lambda deliver: deliver(), Qt.ConnectionType.QueuedConnection)

    def set_source(self, source: DataSource, control: Connection | None) -> None:
        """Replace the source; without ``control`` no requests can be sent.

        Requests without an answer fail; nothing waits for them.
        """
        self._close_requests()
        self.source, self.control = source, control
        self.changed.emit()

    def ask(
        self,
        what: str,
        call: Callable[[Connection], T],
        on_result: Callable[[T], None] | None = None,
        on_error: Callable[[str], None] | None = None,
        *,
        urgent: bool = False,
        quiet: bool = False,
    ) -> None:
        """Send a request; returns at once. Without a server it fails.

        Parameters
        ----------
        what
            Name of the request for messages, as in ``Could not close the loop``.
        call
            Makes the request; runs in a worker thread and must not touch widgets.
        on_result, on_error
            Called in the window's thread with the answer or with the reason of the failure.
        urgent
            A safety request.
        quiet
            Do not emit :attr:`failed`: ``on_error`` reports the failure.
        """
        control = self.control

        def fail(reason: str) -> None:
            if not quiet:
                self.failed.emit(what, reason)
            if on_error is not None:
                on_error(reason)

        if control is None:
            fail("there is no server")
            return

        def deliver(future: Future[T]) -> None:
            if self._closed:
                return
            error: BaseException | None
            if self.control is control:
                self._set_pending(self._pending - 1)
                error = future.exception()
                if error is None and on_result is not None:
                    on_result(future.result())
            else:
                answered = not future.cancelled() and future.exception() is None
                error = None if answered else ServerGone(_REPLACED)
            if error is None:
                return
            if not isinstance(error, EscapeError):
                log.error("%s failed unexpectedly", what, exc_info=error)
            fail(str(error) or type(error).__name__)

        self._set_pending(self._pending + 1)
        if urgent not in self._executors:
            self._executors[urgent] = ThreadPoolExecutor(1, f"escape-gui-{'safety' if urgent else 'request'}")
        future = self._executors[urgent].submit(call, control)
        future.add_done_callback(lambda answer: self._delivered.emit(partial(deliver, answer)))

    def compute(
        self,
        call: Callable[[], T],
        on_result: Callable[[T], None],
        on_error: Callable[[str], None] = lambda reason: None,
    ) -> None:
        """Run a slow function in a worker thread; its result or error is delivered in the window's thread."""

        def deliver(future: Future[T]) -> None:
            if self._closed or future.cancelled():
                return
            error = future.exception()
            if error is None:
                on_result(future.result())
                return
            if not isinstance(error, EscapeError | ValueError):
                log.error("a computation failed unexpectedly", exc_info=error)
            on_error(str(error) or type(error).__name__)

        if self._computing is None:
            self._computing = ThreadPoolExecutor(1, "escape-gui-compute")
        future = self._computing.submit(call)
        future.add_done_callback(lambda answer: self._delivered.emit(partial(deliver, answer)))

    def _set_pending(self, number: int) -> None:
        self._pending = number
        self.pending_changed.emit(number)

    def toggle_pause(self) -> None:
        """Request to pause the running procedure, or to resume it if it is paused."""
        running = self.source.state.active_run
        if running is not None and running.paused:
            self.ask("resume", lambda server: server.resume())
        else:
            self.ask("pause", lambda server: server.pause())

    def abort(self) -> None:
        """Request to stop the running procedure; the data acquired so far are saved."""
        self.ask("abort the procedure", lambda server: server.abort(), urgent=True)

    @property
    def live(self) -> bool:
        """Whether the source is, or will be, a server rather than a recorded run."""
        return self.control is not None or isinstance(self.source, EmptySource)

    @property
    def may_write(self) -> bool:
        """Whether this client holds the lease."""
        lease = self.source.state.lease
        return self.control is not None and lease is not None and lease.client == self.control.client

    @property
    def request_context(self) -> RequestContext:
        """Facts that decide which requests are available now."""
        return RequestContext(self.source.state, self.source.connected, self.live, self.may_write)

    def close(self) -> None:
        self._closed = True
        self._close_requests()
        for worker in self._ended_executors:
            worker.shutdown(wait=True)
        if self._computing is not None:
            self._computing.shutdown(wait=True, cancel_futures=True)
            self._computing = None
        self.library.close()
        self.source = EmptySource()

    def _close_requests(self) -> None:
        """Stop the threads without waiting for them; answers that still arrive are discarded."""
        self.control = None
        for worker in self._executors.values():
            worker.shutdown(wait=False, cancel_futures=True)
        self._ended_executors += self._executors.values()
        self._executors.clear()
        if self._pending:
            self._set_pending(0)


def runs_folder(session: Session) -> Path:
    """Folder of the server's runs if it is on this computer, else the user's."""
    folder = Path(session.source.state.disk.folder or default_runs_folder())
    return folder if folder.is_dir() else default_runs_folder()
