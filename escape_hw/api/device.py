"""What every device has: a name, open and close, and nothing that happens by itself."""

from __future__ import annotations

import abc
import logging
import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import Self, final

from escape_hw.errors import NotOpen

log = logging.getLogger(__name__)


class Device(abc.ABC):
    """A device that is opened, used and closed; usable as a context manager.

    ``open`` and ``close`` may be called any number of times, from any thread. Nothing happens on
    garbage collection, and no vendor library is loaded before ``open``. Drivers fill in ``_open``
    and ``_close``.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self._is_open = False
        #: Held while the connection changes, and by the kinds that must not be closed mid-transfer.
        self._lock = threading.RLock()

    @property
    def is_open(self) -> bool:
        """True between a successful ``open`` and ``close``."""
        return self._is_open

    @final
    def open(self) -> Self:
        """Connect; does nothing when already open.

        Raises
        ------
        DeviceError
            The device cannot be reached; nothing is left half open.
        """
        with self._lock:
            if self._is_open:
                return self
            try:
                self._open()
            except BaseException as cause:
                self._clean_up(self._release_after_failed_open, cause)
                raise
            self._is_open = True
            try:
                self._after_open()
            except BaseException as cause:
                self._is_open = False
                self._clean_up(self._close, cause)
                raise
        return self

    @final
    def close(self) -> None:
        """Leave the device safe and disconnect; does nothing when already closed.

        The connection is closed even when the device cannot be left safe any more.

        Raises
        ------
        DeviceError
            The device could not be left safe (a mirror that was lost is not flat), or did not
            disconnect. It counts as closed all the same.
        """
        with self._lock:
            if not self._is_open:
                return
            try:
                self._before_close()
            except BaseException as cause:
                self._is_open = False
                self._clean_up(self._close, cause)
                raise
            self._is_open = False
            self._close()

    def __enter__(self) -> Self:
        return self.open()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None:
            self.close()
        else:
            self._clean_up(self.close, error)

    def require_open(self) -> None:
        """Raise :class:`NotOpen` unless the device is open."""
        if not self._is_open:
            raise NotOpen(self.name, "not open; call open() first, or use it in a 'with' statement")

    def now_ns(self) -> int:
        """The device's monotonic clock in nanoseconds (a twin's clock is simulated)."""
        return time.monotonic_ns()

    def _clean_up(self, step: Callable[[], None], cause: BaseException) -> None:
        """Take a last step after a failure; if it fails too, the first cause stays the news."""
        try:
            step()
        except Exception as second:
            if type(second) is type(cause) and str(second) == str(cause):
                # A device that is gone says the same of every further step.
                log.debug("again while clearing up: %s", second)
                return
            log.warning("further failure while clearing up: %s: %s", type(second).__name__, second)
            cause.add_note(f"and then, while clearing up: {type(second).__name__}: {second}")

    @abc.abstractmethod
    def _open(self) -> None:
        """Connect to the device."""

    @abc.abstractmethod
    def _close(self) -> None:
        """Disconnect; must not raise when the device has already gone."""

    def _release_after_failed_open(self) -> None:
        """Release whatever a failed ``_open`` left behind."""

    def _after_open(self) -> None:
        """Work of the kind's base class once connected."""

    def _before_close(self) -> None:
        """Work of the kind's base class before disconnecting, such as flattening a mirror."""
