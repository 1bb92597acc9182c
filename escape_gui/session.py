"""Where the window's data come from and where its requests go, neither of which ever stops it."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, Protocol, TypeVar

from PySide6.QtCore import QObject, Qt, Signal

from escape_gui.library import Library
from escape_hw.errors import EscapeError
from escape_hw.remote.source import Sample, Source
from escape_hw.remote.state import Arguments, Geometry, LogLine, Plan, ProcedureEntry, State

log = logging.getLogger(__name__)
T = TypeVar("T")


class Control(Protocol):
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

    def check(self, procedure: str, arguments: Arguments) -> Plan:
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


class Commands(QObject):
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
    waiting_changed = Signal(int)
    _delivered = Signal(object)

    def __init__(self, control: Control) -> None:
        super().__init__()
        self.control = control
        self._workers = {
            urgent: ThreadPoolExecutor(1, f"escape-gui-{'safety' if urgent else 'request'}")
            for urgent in (False, True)
        }
        self._waiting = 0
        self._open = True
        self._delivered.connect(lambda deliver: deliver(), Qt.ConnectionType.QueuedConnection)

    def ask(
        self,
        what: str,
        call: Callable[[Control], T],
        then: Callable[[T], None] | None = None,
        otherwise: Callable[[str], None] | None = None,
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
        if not self._open:
            return
        self._count(+1)
        future = self._workers[urgent].submit(call, self.control)
        future.add_done_callback(
            lambda done: self._delivered.emit(lambda: self._take(what, done, then, otherwise, quiet))
        )

    def _take(
        self,
        what: str,
        future: Future[T],
        then: Callable[[T], None] | None,
        otherwise: Callable[[str], None] | None,
        quiet: bool,
    ) -> None:
        if not self._open:
            return
        self._count(-1)
        error = future.exception()
        if error is None:
            self.done.emit(what)
            if then is not None:
                then(future.result())
            return
        if not isinstance(error, EscapeError):
            log.error("%s failed unexpectedly", what, exc_info=error)
        reason = str(error) or type(error).__name__
        if not quiet:
            self.failed.emit(what, reason)
        if otherwise is not None:
            otherwise(reason)

    def _count(self, step: int) -> None:
        self._waiting += step
        self.waiting_changed.emit(self._waiting)

    def close(self) -> None:
        """Forget what is under way; answers that still come are dropped."""
        self._open = False
        for worker in self._workers.values():
            worker.shutdown(wait=True, cancel_futures=True)


class NoSource:
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

    def check(self, procedure: str, arguments: Arguments) -> Plan:
        """Refuse: there is nobody to ask."""
        raise EscapeError("not connected to a server")


class Session(QObject):
    """What the window looks at now, and how it may write; changes when another source is opened."""

    #: Another source was taken; panels forget what they showed.
    changed = Signal()
    failed = Signal(str, str)
    done = Signal(str)
    waiting_changed = Signal(int)

    def __init__(self) -> None:
        super().__init__()
        self.source: Source = NoSource()
        #: ``None`` while a finished run is replayed.
        self.commands: Commands | None = None
        #: Products that the source names, as panels show them.
        self.library = Library()

    def use(self, source: Source, control: Control | None) -> None:
        """Show this source from now on; without ``control`` nothing can be asked of it."""
        self._drop()
        self.source = source
        if control is not None:
            self.commands = Commands(control)
            self.commands.failed.connect(self.failed)
            self.commands.done.connect(self.done)
            self.commands.waiting_changed.connect(self.waiting_changed)
        self.changed.emit()

    @property
    def live(self) -> bool:
        """Whether this is, or waits for, a server: no recording."""
        return self.commands is not None or isinstance(self.source, NoSource)

    @property
    def may_write(self) -> bool:
        """Whether the lease is ours."""
        lease = self.source.state.lease
        return (
            self.commands is not None and lease is not None and lease.client == self.commands.control.client
        )

    def close(self) -> None:
        """End the worker threads."""
        self._drop()
        self.library.close()
        self.source = NoSource()

    def _drop(self) -> None:
        if self.commands is not None:
            self.commands.close()
            self.commands.deleteLater()
            self.commands = None
