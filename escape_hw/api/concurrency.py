"""A flag that signal handlers may set, and limits on the threads of numerical libraries. Standard library only at import."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from threadpoolctl import threadpool_limits


class SignalSafeFlag:
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


_helper_threads_allowed = True


def disable_helper_threads() -> None:
    """Say that this process is one of as many as there are cores: helper threads would only be in the way.

    Holds for the rest of the process. What was built before keeps its threads.
    """
    global _helper_threads_allowed
    _helper_threads_allowed = False


def helper_threads_allowed() -> bool:
    """Whether threads beside the calling one are welcome; see :func:`disable_helper_threads`."""
    return _helper_threads_allowed


def limit_to_one_thread() -> threadpool_limits:
    """Hold the linear-algebra libraries to one thread.

    Small products, as a loop makes them, are slower on many threads, and pools that spin for each
    other can make them a hundred times slower.

    Returns
    -------
    threadpool_limits
        Usable in a ``with`` statement; its ``restore_original_limits`` ends the hold.
    """
    # Compiled code calls the library that SciPy brings, and only loaded libraries can be held.
    from threadpoolctl import threadpool_limits

    return threadpool_limits(limits=1)
