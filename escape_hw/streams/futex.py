"""Waiting on a word of shared memory, and waking the waiting processes (Linux futex)."""

from __future__ import annotations

import ctypes
import mmap
import os
import platform
import sys
import time
from typing import Final

import numpy as np

#: Number of the system call by architecture.
_NUMBERS: Final = {"x86_64": 202, "aarch64": 98}
_WAIT, _WAKE, _ALL = 0, 1, 2**31 - 1
#: Polling period on systems without futex.
_POLL_S = 0.0002

_NUMBER = _NUMBERS.get(platform.machine()) if sys.platform.startswith("linux") else None
_syscall = ctypes.CDLL(None, use_errno=True).syscall if _NUMBER is not None else None


class _Timespec(ctypes.Structure):
    _fields_ = (("seconds", ctypes.c_long), ("nanoseconds", ctypes.c_long))


def futex_address(memory: mmap.mmap, word: int) -> int:
    """Address of the low half of a 64-bit counter at an offset in words of eight bytes."""
    start = np.frombuffer(memory, np.uint8, 1).ctypes.data
    return start + 8 * word + (0 if sys.byteorder == "little" else 4)


def futex_wait(address: int, value: int, timeout_s: float) -> None:
    """Sleep until :func:`futex_wake` is called for a 32-bit word, unless it differs from ``value``.

    May return spuriously. Releases the interpreter lock.
    """
    if _syscall is None:
        time.sleep(min(_POLL_S, timeout_s))
        return
    whole = int(timeout_s)
    limit = _Timespec(whole, int((timeout_s - whole) * 1e9))
    _syscall(_NUMBER, ctypes.c_void_p(address), _WAIT, ctypes.c_uint32(value), ctypes.byref(limit), None, 0)


def futex_wake(address: int) -> None:
    """Wake all processes that wait on a word; takes about a microsecond.

    Raises ``OSError`` if the address is not in shared memory.
    """
    if _syscall is not None and _syscall(_NUMBER, ctypes.c_void_p(address), _WAKE, _ALL, None, None, 0) < 0:
        error = ctypes.get_errno()
        raise OSError(error, os.strerror(error))
