"""Signal-safe flag, and limits on the threads of numerical libraries. Imports only the standard library."""

from __future__ import annotations

import functools
import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from threadpoolctl import ThreadpoolController, _ThreadpoolLimiter


class SignalSafeFlag:
    """A flag that a signal handler may set.

    It takes no lock. A handler that interrupts itself while it sets a :class:`threading.Event` would
    deadlock.
    """

    __slots__ = ("_set",)

    def __init__(self) -> None:
        self._set = False

    def set(self) -> None:
        """Set the flag."""
        self._set = True

    def is_set(self) -> bool:
        """Whether the flag is set."""
        return self._set


_helper_threads_allowed = True


def disable_helper_threads() -> None:
    """Use no helper threads in this process from now on, because one process per core is running.

    Existing objects keep their threads.
    """
    global _helper_threads_allowed
    _helper_threads_allowed = False


def helper_threads_allowed() -> bool:
    """Whether helper threads may be used; see :func:`disable_helper_threads`."""
    return _helper_threads_allowed


@functools.lru_cache(maxsize=1)
def _linear_algebra_libraries(n_modules: int) -> ThreadpoolController:
    """The loaded libraries. The search takes milliseconds; it is repeated when modules were imported."""
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


def limit_to_one_thread() -> _ThreadpoolLimiter:
    """Limit the linear-algebra libraries to one thread.

    Small matrix products are slower on several threads, up to a hundred times when spinning thread pools
    compete for the cores.

    Returns
    -------
    _ThreadpoolLimiter
        Context manager; its ``restore_original_limits`` removes the limit.
    """
    return _linear_algebra_libraries(len(sys.modules)).limit(limits=1)
