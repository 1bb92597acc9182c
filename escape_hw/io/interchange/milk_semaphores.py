"""The semaphores of an image of milk's, by which its writer wakes whoever waits."""

from __future__ import annotations

import ctypes
import mmap
import os
import time
from typing import Any

import numpy as np

from escape_hw.io.interchange import milk_layout as layout

#: Longest wait on a semaphore before the counter is looked at again: not every writer posts.
_SLICE_S = 0.05
#: Bytes that a semaphore must be aligned to, or the kernel refuses to wait on it.
_ALIGNED = 4
_FREE = -1


class Semaphores:
    """The semaphores of an image, and who waits for them.

    Parameters
    ----------
    memory
        The whole file.
    sections
        Where its sections begin.
    n
        How many semaphores it has.
    """

    def __init__(self, memory: mmap.mmap, sections: layout.Sections, n: int) -> None:
        self._anchor = ctypes.c_char.from_buffer(memory)
        base = ctypes.addressof(self._anchor)
        self._every = [base + sections.semaphores + layout.SEMAPHORE_BYTES * k for k in range(n)]
        self._log = base + sections.log
        self._readers = np.ndarray((n,), np.int32, memory, sections.readers)
        self._writers = np.ndarray((n,), np.int32, memory, sections.writers)
        self._usable = sections.semaphores % _ALIGNED == 0
        self._mine: int | None = None
        self._library = _library()

    def initialise(self) -> None:
        """Make them, all at zero and free."""
        for address in (*self._every, self._log):
            self._library.sem_init(ctypes.c_void_p(address), 1, 0)
        self._readers[:] = self._writers[:] = _FREE

    def post(self) -> None:
        """Wake whoever waits."""
        self._writers[:] = os.getpid()
        if not self._usable:
            return
        value = ctypes.c_int()
        for address in (*self._every, self._log):
            at = ctypes.c_void_p(address)
            self._library.sem_getvalue(at, ctypes.byref(value))
            if value.value < layout.SEMAPHORE_MAX:
                self._library.sem_post(at)

    def wait(self, timeout_s: float) -> bool:
        """Wait for a post, for a while at most; false at once where there is no semaphore to wait on.

        The first call only claims a semaphore: what was posted before does not count, so look again.
        """
        if self._mine is None:
            self._mine = self._claim()
            return self._mine is not None
        until = time.time() + min(timeout_s, _SLICE_S)
        moment = (ctypes.c_int64 * 2)(int(until), int(until % 1 * 1e9))
        self._library.sem_timedwait(ctypes.c_void_p(self._every[self._mine]), ctypes.byref(moment))
        return True

    def release(self) -> None:
        """Give the own semaphore back."""
        if self._mine is not None:
            self._readers[self._mine] = _FREE
            self._mine = None

    def _claim(self) -> int | None:
        """A semaphore that nobody waits for, marked as this process's, and emptied."""
        for k, pid in enumerate(self._readers if self._usable else ()):
            if not _alive(int(pid)):
                self._readers[k] = os.getpid()
                while self._library.sem_trywait(ctypes.c_void_p(self._every[k])) == 0:
                    pass
                return k
        return None


def _alive(pid: int) -> bool:
    if pid <= 0:
        return False
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def _library() -> Any:
    """The C library of this process, whose semaphores milk uses, too."""
    return ctypes.CDLL(None, use_errno=True)
