"""Ctrl-C that leaves the mirror flat."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType, TracebackType
from typing import Any, Self

from escape_hw.api.flag import Flag


class Interrupts:
    """Turns SIGINT and SIGTERM into an orderly stop.

    While a procedure runs, the first one sets ``abort``, the second breaks in at once. While the
    devices are being closed, or an aborted run is saved, they change nothing: the mirror gets its
    flat shape and the data their file. At any other time they break in at once. Does nothing outside
    the main thread.

    Parameters
    ----------
    tell
        Called with a line for the operator, out of a signal handler.
    """

    def __init__(self, tell: Callable[[str], None]) -> None:
        self.abort = Flag()
        self._tell = tell
        self._in_procedure = False
        self._shielded = ""
        self._previous: dict[int, Any] = {}

    def __enter__(self) -> Self:
        """Install the handlers."""
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._previous[number] = signal.signal(number, self._handle)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Put the former handlers back."""
        for number, handler in self._previous.items():
            signal.signal(number, handler)
        self._previous.clear()

    @contextmanager
    def procedure(self) -> Iterator[Flag]:
        """While a procedure runs: yields the flag that aborts it."""
        self._in_procedure = True
        try:
            yield self.abort
        finally:
            self._in_procedure = False

    def begin_closing(self) -> None:
        """From here to :meth:`end_closing` nothing breaks in."""
        self._shielded = "the mirror is being flattened and the devices closed"

    def end_closing(self) -> None:
        """The devices are closed."""
        self._shielded = ""

    @contextmanager
    def saving(self) -> Iterator[None]:
        """While what an aborted run measured is saved, which takes a moment, nothing breaks in."""
        self._shielded = "what was measured is being saved"
        try:
            yield
        finally:
            self._shielded = ""

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self._shielded:
            self._tell(f"already stopping: {self._shielded}")
        elif self._in_procedure and not self.abort.is_set():
            self.abort.set()
            self._tell("stopping: the mirror is flattened and what was measured is saved")
        else:
            raise KeyboardInterrupt
