"""Threads of the linear-algebra libraries, which fight when they are many."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from threadpoolctl import threadpool_limits

_alone = True


def share_cores() -> None:
    """Say that this process is one of as many as there are cores: helper threads would only be in the way.

    Holds for the rest of the process. What was built before keeps its threads.
    """
    global _alone
    _alone = False


def helper_threads() -> bool:
    """Whether threads beside the calling one are welcome; see :func:`share_cores`."""
    return _alone


def hold_to_one_thread() -> threadpool_limits:
    """Hold the linear-algebra libraries to one thread.

    Small products, as a loop makes them, are slower on many threads, and pools that spin for each
    other can make them a hundred times slower.

    Returns
    -------
    threadpool_limits
        Usable in a ``with`` statement; its ``restore_original_limits`` ends the hold.
    """
    # Compiled code calls the library that SciPy brings, and only loaded libraries can be held.
    import scipy.linalg.cython_blas  # noqa: F401
    from threadpoolctl import threadpool_limits

    return threadpool_limits(limits=1)
