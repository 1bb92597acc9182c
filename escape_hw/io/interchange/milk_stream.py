"""Shared-memory images of milk and CACAO, read and written without their library."""

from __future__ import annotations

import contextlib
import ctypes
import mmap
import os
import time
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from escape_hw.errors import ProductError, StorageError
from escape_hw.io.interchange import milk_layout as layout
from escape_hw.io.interchange.stream import Publication, StreamLost
from escape_hw.io.storage import storage_error

#: Seconds between looks at the counter where no semaphore is free, and before a torn read is given up.
_LOOK_S, _TORN_S = 5e-5, 1.0
#: Longest wait on a semaphore before the counter is looked at again: not every writer posts.
_SLICE_S = 0.05
#: Bytes that a semaphore must be aligned to, or the kernel refuses to wait on it.
_ALIGNED = 4
_FREE = -1


class MilkStream:
    """An open image; see :class:`~escape_hw.io.interchange.stream.Stream`.

    Made by :meth:`open` or :meth:`create`. A reader waits on one of the image's semaphores, which it marks
    as its own and gives back on closing.

    Parameters
    ----------
    name
        Name of the image.
    memory
        Its whole file.
    """

    def __init__(self, name: str, memory: mmap.mmap) -> None:
        self.name, self._memory = name, memory
        self._head = layout.Metadata.from_buffer(memory)
        self.shape = layout.shape_of(self._head)
        self.dtype: DTypeLike = layout.DTYPES[self._head.datatype]
        self._data: NDArray[Any] = np.ndarray(self.shape, self.dtype, memory, layout.HEADER_BYTES)
        sections = layout.found_sections(self._head, len(memory))
        self._semaphores = None if sections is None else _Semaphores(memory, sections, self._head.sem)

    @classmethod
    def open(cls, name: str) -> MilkStream:
        """Attach to an image that exists.

        Raises
        ------
        ProductError
            There is none of that name, or it is laid out in a way that is not known here.
        """
        path = layout.shm_path(name)
        try:
            with path.open("r+b") as file:
                if os.fstat(file.fileno()).st_size < layout.HEADER_BYTES:
                    raise ProductError(f"{path}: too short for an image of milk's")
                memory = mmap.mmap(file.fileno(), 0)
        except OSError as error:
            way = "is MILK_SHM_DIR set as for milk?" if isinstance(error, FileNotFoundError) else "see ls -l"
            raise ProductError(f"{path}: cannot be opened ({error.strerror or error}); {way}") from error
        problem = layout.problem_of(layout.Metadata.from_buffer_copy(memory), len(memory))
        if problem is not None:
            memory.close()
            raise ProductError(f"{path}: {problem}")
        return cls(name, memory)

    @classmethod
    def create(
        cls, name: str, shape: tuple[int, ...], dtype: DTypeLike, *, version: str = layout.VERSION
    ) -> MilkStream:
        """Make an image, in place of one of that name; whoever holds that keeps its old file.

        Parameters
        ----------
        name, shape, dtype
            See :func:`~escape_hw.io.interchange.milk_layout.fresh_metadata`.
        version
            Version that the metadata claim. milk opens no image whose version is not its own.

        Raises
        ------
        ValueError
            milk has no such image.
        StorageError
            The file cannot be made.
        """
        head = layout.fresh_metadata(name, shape, dtype, version)
        sections, path = layout.sections(head, 8), layout.shm_path(name)
        try:
            path.unlink(missing_ok=True)
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
            try:
                os.truncate(descriptor, sections.total)
                head.inode = os.fstat(descriptor).st_ino
                memory = mmap.mmap(descriptor, sections.total)
            finally:
                os.close(descriptor)
        except OSError as error:
            raise _unwritable(path, error) from error
        now = time.clock_gettime_ns(time.CLOCK_TAI)
        for moment in (head.creationtime, head.lastaccesstime):
            moment.seconds, moment.nanoseconds = divmod(now, 1_000_000_000)
        _Semaphores(memory, sections, head.sem).initialise()
        # The version comes last: until it is there, nobody opens the image.
        claimed, head.version = head.version, b""
        memory[: layout.HEADER_BYTES] = bytes(head)
        memory[: len(claimed)] = claimed
        return cls(name, memory)

    @property
    def count(self) -> int:
        """Number of the newest write."""
        return int(self._head.cnt0)

    def latest(self) -> Publication:
        """See :meth:`~escape_hw.io.interchange.stream.Stream.latest`."""
        head, deadline = self._head, time.monotonic() + _TORN_S
        while True:
            count, seconds, nanoseconds = head.cnt0, head.writetime.seconds, head.writetime.nanoseconds
            if not head.write:
                data = self._data.copy()
                if head.cnt0 == count and not head.write:
                    return Publication(data, int(count), _unix_ns(seconds, nanoseconds))
            if time.monotonic() > deadline:
                raise StreamLost(f"image '{self.name}': its writer has not finished for {_TORN_S:g} s")
            time.sleep(0)

    def after(self, count: int, timeout_s: float) -> Publication | None:
        """See :meth:`~escape_hw.io.interchange.stream.Stream.after`."""
        deadline = time.monotonic() + timeout_s
        while self._head.cnt0 <= count:
            left = deadline - time.monotonic()
            if left <= 0:
                return None
            if self._semaphores is None or not self._semaphores.wait(left):
                time.sleep(min(_LOOK_S, left))
        return self.latest()

    def write(self, data: NDArray[Any]) -> None:
        """See :meth:`~escape_hw.io.interchange.stream.Stream.write`; posts the semaphores."""
        if np.shape(data) != self.shape:
            raise ValueError(f"image '{self.name}' has shape {self.shape}, the array {np.shape(data)}")
        head = self._head
        head.write = 1
        self._data[...] = data
        now = divmod(time.clock_gettime_ns(time.CLOCK_TAI), 1_000_000_000)
        for moment in (head.atime, head.writetime):
            moment.seconds, moment.nanoseconds = now
        head.cnt0 += 1
        head.write = 0
        if self._semaphores is not None:
            self._semaphores.post()

    def close(self) -> None:
        """See :meth:`~escape_hw.io.interchange.stream.Stream.close`; gives its semaphore back."""
        if self._memory.closed:
            return
        if self._semaphores is not None:
            self._semaphores.release()
        # Views keep the memory from being unmapped.
        del self._head, self._data, self._semaphores
        self._memory.close()

    def unlink(self) -> None:
        """Remove the image for everybody who has not opened it yet."""
        layout.shm_path(self.name).unlink(missing_ok=True)


class _Semaphores:
    """The semaphores of an image, and who waits for them."""

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


def _unix_ns(seconds: int, nanoseconds: int) -> int:
    """A time of milk's (international atomic time) as Unix time; 0 stays 0."""
    if seconds == 0:
        return 0
    ahead = time.clock_gettime_ns(time.CLOCK_TAI) - time.time_ns()
    # Both clocks were read one after the other; what differs is whole seconds, or nothing.
    return seconds * 1_000_000_000 + nanoseconds - round(ahead / 1e9) * 1_000_000_000


def _unwritable(path: Any, error: OSError) -> StorageError:
    with contextlib.suppress(OSError):
        path.unlink(missing_ok=True)
    return storage_error(path, error)
