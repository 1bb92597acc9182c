"""What every device has: a name, open and close, and nothing that happens by itself."""

from __future__ import annotations

import abc
import time
from types import TracebackType
from typing import Self, final

from escape_hw.errors import NotOpen


class Device(abc.ABC):
    """A device that is opened, used and closed; usable as a context manager.

    ``open`` and ``close`` may be called any number of times. Nothing happens on garbage
    collection, and no vendor library is loaded before ``open``. Drivers fill in ``_open`` and
    ``_close``.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self._is_open = False

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
        if not self._is_open:
            try:
                self._open()
            except BaseException:
                self._abandon()
                raise
            self._is_open = True
            self._after_open()
        return self

    @final
    def close(self) -> None:
        """Leave the device safe and disconnect; does nothing when already closed."""
        if self._is_open:
            try:
                self._before_close()
            finally:
                self._is_open = False
                self._close()

    def __enter__(self) -> Self:
        return self.open()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def require_open(self) -> None:
        """Raise :class:`NotOpen` unless the device is open."""
        if not self._is_open:
            raise NotOpen(self.name, "not open; call open() first, or use it in a 'with' statement")

    def now_ns(self) -> int:
        """The device's monotonic clock in nanoseconds (a twin's clock is simulated)."""
        return time.monotonic_ns()

    @abc.abstractmethod
    def _open(self) -> None:
        """Connect to the device."""

    @abc.abstractmethod
    def _close(self) -> None:
        """Disconnect; must not raise when the device has already gone."""

    def _abandon(self) -> None:  # noqa: B027 - an optional hook
        """Release whatever a failed ``_open`` left behind."""

    def _after_open(self) -> None:  # noqa: B027 - an optional hook
        """Work of the kind's base class once connected."""

    def _before_close(self) -> None:  # noqa: B027 - an optional hook
        """Work of the kind's base class before disconnecting, such as flattening a mirror."""
