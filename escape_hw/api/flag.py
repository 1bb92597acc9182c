"""A flag between threads and signal handlers."""

from __future__ import annotations


class Flag:
    """A flag that a signal handler may set.

    It takes no lock, unlike :class:`threading.Event`: a handler that interrupts itself in the midst
    of setting an event waits for itself for ever.
    """

    __slots__ = ("_set",)

    def __init__(self) -> None:
        self._set = False

    def set(self) -> None:
        """Raise the flag."""
        self._set = True

    def is_set(self) -> bool:
        """Whether it was raised."""
        return self._set
