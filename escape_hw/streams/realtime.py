"""Telling the operating system that a thread must not wait: processor, priority, memory that stays."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import sys
from collections.abc import Callable, Collection, Iterator
from pathlib import Path

#: Above all that is usual, below the kernel's own threads.
PRIORITY = 40
#: Seconds after which another Python thread gives way: at most so long may one hold up the loop.
SWITCH_INTERVAL_S = 0.0005
_LOCK_PRESENT = 1
_ISOLATED = Path("/sys/devices/system/cpu/isolated")


def isolated_cpus(path: Path = _ISOLATED) -> tuple[int, ...]:
    """Processors that this machine keeps free of everything else (boot option ``isolcpus``)."""
    try:
        parts = [part.split("-") for part in path.read_text().strip().split(",") if part]
        return tuple(cpu for ends in parts for cpu in range(int(ends[0]), int(ends[-1]) + 1))
    except (OSError, ValueError):
        return ()


@contextlib.contextmanager
def realtime_thread(
    cpus: Collection[int] | None = None, priority: int = PRIORITY
) -> Iterator[tuple[str, ...]]:
    """Run this thread before others, as far as the machine allows, and give up all of it in the end.

    Threads and processes that it starts do not inherit the priority.

    Parameters
    ----------
    cpus
        Processors to run on; ``None``: any.
    priority
        Of SCHED_FIFO, 1 to 99; 0 leaves it.

    Yields
    ------
    tuple of str
        What was not allowed, in words for the state; empty when all was.
    """
    notes: list[str] = []
    with contextlib.ExitStack() as undo:
        # What there is now is looked at no more when garbage is collected, or that takes milliseconds.
        gc.freeze()
        undo.callback(gc.unfreeze)
        interval = sys.getswitchinterval()
        sys.setswitchinterval(SWITCH_INTERVAL_S)
        undo.callback(sys.setswitchinterval, interval)
        if cpus is not None:
            _attempt(notes, "processors cannot be chosen", lambda: _pin_to_cpus(frozenset(cpus), undo))
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
    """Keep what is in memory now there; what is mapped later is not held, or large runs would fail."""
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(_LOCK_PRESENT):
        error = ctypes.get_errno()
        raise OSError(error, os.strerror(error))
    undo.callback(libc.munlockall)
