"""Where the window's data come from and where its requests go, neither of which ever stops it."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, Protocol, TypeVar

from PySide6.QtCore import QObject, Qt, Signal

from escape_gui.client.product_library import ProductLibrary
from escape_hw.errors import EscapeError
from escape_hw.remote.source import DataSource, Sample
from escape_hw.remote.state import Arguments, Geometry, LogLine, ProcedureEntry, ProcedurePlan, State

log = logging.getLogger(__name__)
T = TypeVar("T")


class ServerControl(Protocol):
    """What a window may ask of a server; each call waits for the answer and raises what went wrong."""

    @property
    def client(self) -> str:
        """Who we are, as in ``State.lease.client``."""
        ...

    def acquire(self, take_over: bool = False) -> object:
        """Ask for the right to write."""
        ...

    def release(self) -> object:
        """Give it back."""
        ...

    def open_loop(self) -> object:
        """Open the loop and flatten."""
        ...

    def flatten(self) -> object:
        """Abort everything, ramp the mirror flat."""
        ...

    def abort(self) -> object:
        """Stop the running procedure."""
        ...

    def plan(self, procedure: str, arguments: Arguments) -> ProcedurePlan:
        """What a procedure would do."""
        ...

    def start(self, procedure: str, **arguments: Any) -> object:
        """Start a procedure."""
        ...

    def pause(self) -> object:
        """Halt it between two steps."""
        ...

    def resume(self) -> object:
        """Go on."""
        ...

    def close_loop(
        self,
        matrix: str,
        gain: float | None = None,
        leak: float | None = None,
        dropped_modes: int | None = None,
    ) -> object:
        """Close the loop until it is opened."""
        ...

    def set_loop(
        self,
        matrix: str | None = None,
        gain: float | None = None,
        leak: float | None = None,
        dropped_modes: int | None = None,
    ) -> object:
        """Other parameters for the loop."""
        ...

    def load_product(self, path: str, name: str | None = None) -> object:
        """Load a FITS product into the engine."""
        ...

    def record(self, on: bool) -> object:
        """Record telemetry, or stop it."""
        ...

    def clear_fault(self) -> object:
        """End a fault's latch."""
        ...


class RequestSender(QObject):
    """Sends requests from threads of its own and brings the answers back into the window's.

    Safety requests have a thread to themselves, so that none waits behind a slow question.

    Parameters
    ----------
    control
        The server.
    """

    #: What was asked, and why it failed.
    failed = Signal(str, str)
    #: What was asked and done.
    done = Signal(str)
    #: How many requests wait for their answer.
    pending_changed = Signal(int)
    _delivered = Signal(object)

    def __init__(self, control: ServerControl) -> None:
        super().__init__()
        self.control = control
        self._executors = {
            urgent: ThreadPoolExecutor(1, f"escape-gui-{'safety' if urgent else 'request'}")
            for urgent in (False, True)
        }
        self._pending = 0
        self._accepting = True
        self._delivered.connect(lambda deliver: deliver(), Qt.ConnectionType.QueuedConnection)

    def ask(
        self,
        what: str,
        call: Callable[[ServerControl], T],
        on_result: Callable[[T], None] | None = None,
        on_error: Callable[[str], None] | None = None,
        *,
        urgent: bool = False,
        quiet: bool = False,
    ) -> None:
        """Send a request; returns at once.

        Parameters
        ----------
        what
            In the operator's words, for messages: ``close the loop``.
        call
            Makes the request; runs in a worker thread and must not touch widgets.
        then, otherwise
            Called in the window's thread with the answer, or with the reason of a failure; the
            failure is also told through :attr:`failed`.
        urgent
            A safety request.
        quiet
            Whoever asked tells of a failure; it is not told through :attr:`failed`.
        """
        if not self._accepting:
            return
        self._change_pending(+1)
        future = self._executors[urgent].submit(call, self.control)
        future.add_done_callback(
            lambda done: self._delivered.emit(
                lambda: self._deliver_result(what, done, on_result, on_error, quiet)
            )
        )

    def _deliver_result(
        self,
        what: str,
        future: Future[T],
        on_result: Callable[[T], None] | None,
        on_error: Callable[[str], None] | None,
        quiet: bool,
    ) -> None:
        if not self._accepting:
            return
        self._change_pending(-1)
        error = future.exception()
        if error is None:
            self.done.emit(what)
            if on_result is not None:
                on_result(future.result())
            return
        if not isinstance(error, EscapeError):
            log.error("%s failed unexpectedly", what, exc_info=error)
        reason = str(error) or type(error).__name__
        if not quiet:
            self.failed.emit(what, reason)
        if on_error is not None:
            on_error(reason)

    def _change_pending(self, step: int) -> None:
        self._pending += step
        self.pending_changed.emit(self._pending)

    def close(self) -> None:
        """Forget what is under way; answers that still come are dropped."""
        self._accepting = False
        for worker in self._executors.values():
            worker.shutdown(wait=True, cancel_futures=True)


class EmptySource:
    """A source that has nothing: what a window shows before it is connected."""

    connected = False
    state = State()

    def latest(self, stream: str, after: int = -1) -> Sample | None:
        """Nothing."""
        return None

    def geometry(self) -> Geometry:
        """Nothing known."""
        return Geometry()

    def log_after(self, number: int) -> Sequence[LogLine]:
        """No lines."""
        return ()

    def procedures(self) -> Sequence[ProcedureEntry]:
        """None."""
        return ()

    def plan(self, procedure: str, arguments: Arguments) -> ProcedurePlan:
        """Refuse: there is nobody to ask."""
        raise EscapeError("not connected to a server")


class Session(QObject):
    """What the window looks at now, and how it may write; changes when another source is opened."""

    #: Another source was taken; panels forget what they showed.
    changed = Signal()
    failed = Signal(str, str)
    done = Signal(str)
    pending_changed = Signal(int)

    def __init__(self) -> None:
        super().__init__()
        self.source: DataSource = EmptySource()
        #: ``None`` while a finished run is replayed.
        self.requests: RequestSender | None = None
        #: Products that the source names, as panels show them.
        self.library = ProductLibrary()

    def set_source(self, source: DataSource, control: ServerControl | None) -> None:
        """Show this source from now on; without ``control`` nothing can be asked of it."""
        self._close_requests()
        self.source = source
        if control is not None:
            self.requests = RequestSender(control)
            self.requests.failed.connect(self.failed)
            self.requests.done.connect(self.done)
            self.requests.pending_changed.connect(self.pending_changed)
        self.changed.emit()

    @property
    def live(self) -> bool:
        """Whether this is, or waits for, a server: no recording."""
        return self.requests is not None or isinstance(self.source, EmptySource)

    @property
    def may_write(self) -> bool:
        """Whether the lease is ours."""
        lease = self.source.state.lease
        return (
            self.requests is not None and lease is not None and lease.client == self.requests.control.client
        )

    def close(self) -> None:
        """End the worker threads."""
        self._close_requests()
        self.library.close()
        self.source = EmptySource()

    def _close_requests(self) -> None:
        if self.requests is not None:
            self.requests.close()
            self.requests.deleteLater()
            self.requests = None
