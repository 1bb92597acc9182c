"""Real-time settings of a thread: processor affinity, priority, locked memory."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import sys
from collections.abc import Callable, Collection, Iterator
from pathlib import Path

#: Above ordinary threads, below the kernel's own.
PRIORITY = 40
#: Switch interval of Python threads: the longest delay of the loop by another thread.
SWITCH_INTERVAL_S = 0.0005
_LOCK_PRESENT = 1
_ISOLATED = Path("/sys/devices/system/cpu/isolated")


def isolated_cpus() -> tuple[int, ...]:
    """Processors that are isolated from the scheduler (boot option ``isolcpus``)."""
    try:
        parts = [part.split("-") for part in _ISOLATED.read_text().strip().split(",") if part]
        return tuple(cpu for ends in parts for cpu in range(int(ends[0]), int(ends[-1]) + 1))
    except (OSError, ValueError):
        return ()


@contextlib.contextmanager
def realtime_thread(
    cpus: Collection[int] | None = None, priority: int = PRIORITY
) -> Iterator[tuple[str, ...]]:
    """Context manager: run this thread with real-time settings, as far as the system permits.

    All settings are restored at the end. Threads and processes that it starts do not inherit the priority.

    Parameters
    ----------
    cpus
        Processors to run on; ``None`` for any.
    priority
        SCHED_FIFO priority, 1 to 99; 0 leaves it unchanged.

    Yields
    ------
    tuple of str
        Messages on settings that were refused; empty when all were applied.
    """
    notes: list[str] = []
    with contextlib.ExitStack() as undo:
        # Exclude existing objects from garbage collection, which would take milliseconds.
        gc.freeze()
        undo.callback(gc.unfreeze)
        interval = sys.getswitchinterval()
        sys.setswitchinterval(SWITCH_INTERVAL_S)
        undo.callback(sys.setswitchinterval, interval)
        if cpus is not None:
            _attempt(notes, "processor affinity refused", lambda: _pin_to_cpus(frozenset(cpus), undo))
        if priority:
            _attempt(
                notes, "no real-time priority (allow it with 'rtprio' in /etc/security/limits.d)",
                lambda: _raise_priority(priority, undo),
            )  # fmt: skip
            _attempt(
                notes, "memory may be swapped out (allow 'memlock' in /etc/security/limits.d)",
                lambda: _lock_memory(undo),
            )  # fmt: skip
        yield tuple(notes)


def _attempt(notes: list[str], message: str, step: Callable[[], None]) -> None:
    try:
        step()
    except (OSError, AttributeError) as error:
        notes.append(f"{message}: {error}")


def _pin_to_cpus(cpus: frozenset[int], undo: contextlib.ExitStack) -> None:
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, cpus)
    undo.callback(os.sched_setaffinity, 0, before)


def _raise_priority(priority: int, undo: contextlib.ExitStack) -> None:
    policy, usual = os.sched_getscheduler(0), os.sched_getparam(0)
    os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
    undo.callback(os.sched_setscheduler, 0, policy, usual)


def _lock_memory(undo: contextlib.ExitStack) -> None:
    """Lock the present memory; later mappings are not locked, or large runs would fail."""
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(_LOCK_PRESENT):
        error = ctypes.get_errno()
        raise OSError(error, os.strerror(error))
    undo.callback(libc.munlockall)
