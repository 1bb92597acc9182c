"""A shared-memory image of milk or CACAO as a stream: its semaphores, its data and circular buffer."""

from __future__ import annotations

import contextlib
import ctypes
import mmap
import os
import time
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from escape_hw.errors import ProductError
from escape_hw.io.interchange.milk import layout
from escape_hw.io.interchange.stream import Publication, StreamReadError
from escape_hw.io.storage import storage_error

#: Maximum wait on a semaphore before the counter is read again: not every writer posts.
_WAIT_SLICE_S = 0.05
#: Bytes that a semaphore must be aligned to, or the kernel refuses to wait on it.
_ALIGNMENT = 4
_FREE = -1


class Semaphores:
    """The ``n`` semaphores of an image, in the memory of its file."""

    def __init__(self, memory: mmap.mmap, sections: layout.Sections, n: int) -> None:
        self._buffer = ctypes.c_char.from_buffer(memory)
        base = ctypes.addressof(self._buffer)
        self._addresses = [base + sections.semaphores + layout.SEMAPHORE_BYTES * k for k in range(n)]
        self._log = base + sections.log
        self._readers = np.ndarray((n,), np.int32, memory, sections.readers)
        self._writers = np.ndarray((n,), np.int32, memory, sections.writers)
        self._is_aligned = sections.semaphores % _ALIGNMENT == 0
        self._own_index: int | None = None
        # milk uses the semaphores of the C library.
        self._c_library = ctypes.CDLL(None, use_errno=True)

    def initialise(self) -> None:
        """Make them, all at zero and free."""
        for address in (*self._addresses, self._log):
            self._c_library.sem_init(ctypes.c_void_p(address), 1, 0)
        self._readers[:] = self._writers[:] = _FREE

    def post(self) -> None:
        """Wake the waiting readers."""
        self._writers[:] = os.getpid()
        if not self._is_aligned:
            return
        value = ctypes.c_int()
        for address in (*self._addresses, self._log):
            at = ctypes.c_void_p(address)
            self._c_library.sem_getvalue(at, ctypes.byref(value))
            if value.value < layout.SEMAPHORE_MAX:
                self._c_library.sem_post(at)

    def wait(self, timeout_s: float) -> bool:
        """Wait for a post up to a time limit; returns false at once without a semaphore.

        The first call only claims a semaphore and ignores earlier posts: read the counter afterwards.
        """
        if self._own_index is None:
            self._own_index = self._reserve()
            return self._own_index is not None
        until = time.time() + min(timeout_s, _WAIT_SLICE_S)
        moment = (ctypes.c_int64 * 2)(int(until), int(until % 1 * 1e9))
        self._c_library.sem_timedwait(ctypes.c_void_p(self._addresses[self._own_index]), ctypes.byref(moment))
        return True

    def release(self) -> None:
        """Give the own semaphore back."""
        if self._own_index is not None:
            self._readers[self._own_index] = _FREE
            self._own_index = None

    def _reserve(self) -> int | None:
        """A free semaphore, claimed for this process and emptied."""
        for k, pid in enumerate(self._readers if self._is_aligned else ()):
            if not _process_exists(int(pid)):
                self._readers[k] = os.getpid()
                while self._c_library.sem_trywait(ctypes.c_void_p(self._addresses[k])) == 0:
                    pass
                return k
        return None


def _process_exists(pid: int) -> bool:
    if pid <= 0:
        return False
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


class Slices:
    """The newest array of an image and the place of the next one, in the memory of its file."""

    def __init__(self, memory: mmap.mmap, head: layout.Metadata, sections: layout.Sections) -> None:
        image, dtype = layout.image_shape(head), layout.DTYPES[head.datatype]
        self._head, self._circular = head, layout.is_circular(head)
        self.shape = image[1:] if self._circular else image
        self._n_slices = image[0] if self._circular else 1
        self._data: NDArray[Any] = np.ndarray((self._n_slices, *self.shape), dtype, memory, sections.data)
        self._ring: NDArray[Any] = np.ndarray(
            (head.ring_size, self._n_slices, *self.shape), dtype, memory, sections.ring
        )
        n = self._n_slices if layout.is_stamped(head) else 0
        # Seconds and nanoseconds.
        self._acquired: NDArray[np.int64] = np.ndarray((n, 2), np.int64, memory, sections.acquired)
        self._written: NDArray[np.int64] = np.ndarray((n, 2), np.int64, memory, sections.written)
        self._counts: NDArray[np.uint64] = np.ndarray((n,), np.uint64, memory, sections.counts)
        self._triggers: NDArray[np.int32] = np.ndarray(
            (head.n_traces,),
            np.int32,
            memory,
            sections.traces + layout.TRACE_SEMAPHORE,
            (layout.TRACE_BYTES,),
        )

    def initialise(self) -> None:
        """Nothing has triggered a writer yet."""
        self._triggers[:] = -1

    def newest(self) -> NDArray[Any]:
        """The newest array, in place."""
        newest: NDArray[Any] = self._data[self._head.cnt1 % self._n_slices if self._circular else 0]
        return newest

    def put(self, data: NDArray[Any]) -> None:
        """Write an array; readers see it when the metadata are updated."""
        head = self._head
        self._data[self._next()] = data
        if head.ring_size:
            slot = head.ring_index + 1
            if slot >= head.ring_size:
                slot, head.ring_cycle = 0, head.ring_cycle + 1
            self._ring[slot] = self._data
            head.ring_index = slot

    def stamp(self) -> None:
        """Make the array that was put the newest, with the times and the count of the metadata."""
        if not self._circular:
            return
        head, slot = self._head, self._next()
        if len(self._counts):
            self._acquired[slot] = head.atime.seconds, head.atime.nanoseconds
            self._written[slot] = head.writetime.seconds, head.writetime.nanoseconds
            self._counts[slot] = head.cnt0
        head.cnt1 = slot

    def _next(self) -> int:
        return (self._head.cnt1 + 1) % self._n_slices if self._circular else 0


#: Seconds between reads of the counter without a free semaphore, and before a torn read is an error.
_POLL_S, _TORN_READ_TIMEOUT_S = 5e-5, 1.0
#: milk makes its images readable and writable for all users, independent of the umask.
_MODE = 0o666


class MilkStream:
    """An open image; see :class:`~escape_hw.io.interchange.stream.Stream`.

    Made by :meth:`open` or :meth:`create`. A reader waits on one of the image's semaphores, which it marks
    as its own and gives back on closing. Of a circular buffer, the arrays are its slices.
    """

    def __init__(self, name: str, memory: mmap.mmap) -> None:
        self.name, self._memory = name, memory
        self._head = layout.Metadata.from_buffer(memory)
        self.dtype: DTypeLike = layout.DTYPES[self._head.datatype]
        sections = layout.detect_sections(self._head, len(memory))
        if sections is None:
            raise ValueError(f"image '{name}': {layout.find_problem(self._head, len(memory))}")
        self._slices = Slices(memory, self._head, sections)
        self.shape = self._slices.shape
        self._semaphores = Semaphores(memory, sections, self._head.sem)

    @classmethod
    def open(cls, name: str) -> MilkStream:
        """Attach to an image that exists.

        Raises
        ------
        ProductError
            No image has that name, or its layout is unknown.
        """
        path = layout.shm_path(name)
        try:
            with path.open("r+b") as file:
                if os.fstat(file.fileno()).st_size < layout.HEADER_BYTES:
                    raise ProductError(f"{path}: too short for a milk image")
                memory = mmap.mmap(file.fileno(), 0)
        except OSError as error:
            way = "is MILK_SHM_DIR set as for milk?" if isinstance(error, FileNotFoundError) else "see ls -l"
            raise ProductError(f"{path}: cannot be opened ({error.strerror or error}); {way}") from error
        problem = layout.find_problem(layout.Metadata.from_buffer_copy(memory), len(memory))
        if problem is not None:
            memory.close()
            raise ProductError(f"{path}: {problem}")
        return cls(name, memory)

    @classmethod
    def create(
        cls, name: str, shape: tuple[int, ...], dtype: DTypeLike, *, version: str = layout.VERSION
    ) -> MilkStream:
        """Create an image and replace one of that name; processes that have opened the old one keep it.

        All users may write to it, as to images made by milk.

        ``name``, ``shape`` and ``dtype`` are those of
        :func:`~escape_hw.io.interchange.milk.layout.build_metadata`. milk opens only images of its own
        version.

        Raises
        ------
        ValueError
            milk has no such image.
        StorageError
            The file cannot be created.
        """
        head = layout.build_metadata(name, shape, dtype, version)
        sections, path = layout.compute_sections(head, 8), layout.shm_path(name)
        # The image gets its name only when it is complete.
        temporary = path.with_name(f"{path.name}.{os.getpid()}")
        try:
            temporary.unlink(missing_ok=True)
            descriptor = os.open(temporary, os.O_RDWR | os.O_CREAT | os.O_EXCL, _MODE)
            try:
                os.fchmod(descriptor, _MODE)
                # A file with holes would end this process at its first write, were memory short.
                os.posix_fallocate(descriptor, 0, sections.total)
                head.inode = os.fstat(descriptor).st_ino
                memory = mmap.mmap(descriptor, sections.total)
            finally:
                os.close(descriptor)
            now = time.clock_gettime_ns(time.CLOCK_TAI)
            for moment in (head.creationtime, head.lastaccesstime):
                moment.seconds, moment.nanoseconds = divmod(now, 1_000_000_000)
            memory[: layout.HEADER_BYTES] = bytes(head)
            stream = cls(name, memory)
            stream._semaphores.initialise()
            stream._slices.initialise()
            temporary.replace(path)
        except OSError as error:
            with contextlib.suppress(OSError):
                temporary.unlink(missing_ok=True)
            raise storage_error(path, error) from error
        return stream

    @property
    def count(self) -> int:
        """Number of the newest write."""
        return int(self._head.cnt0)

    def latest(self) -> Publication:
        """See :meth:`~escape_hw.io.interchange.stream.Stream.latest`."""
        head, deadline = self._head, time.monotonic() + _TORN_READ_TIMEOUT_S
        while True:
            count, seconds, nanoseconds = head.cnt0, head.writetime.seconds, head.writetime.nanoseconds
            if not head.write:
                data = self._slices.newest().copy()
                if head.cnt0 == count and not head.write:
                    return Publication(data, int(count), _unix_ns(seconds, nanoseconds))
            if time.monotonic() > deadline:
                raise StreamReadError(
                    f"image '{self.name}': its writer has not finished for {_TORN_READ_TIMEOUT_S:g} s"
                )
            time.sleep(0)

    def read_after(self, count: int, timeout_s: float) -> Publication | None:
        """See :meth:`~escape_hw.io.interchange.stream.Stream.read_after`."""
        deadline = time.monotonic() + timeout_s
        while self._head.cnt0 <= count:
            left = deadline - time.monotonic()
            if left <= 0:
                return None
            if not self._semaphores.wait(left):
                time.sleep(min(_POLL_S, left))
        return self.latest()

    def write(self, data: NDArray[Any]) -> None:
        """See :meth:`~escape_hw.io.interchange.stream.Stream.write`; posts the semaphores."""
        if np.shape(data) != self.shape:
            raise ValueError(f"image '{self.name}' has shape {self.shape}, the array {np.shape(data)}")
        head = self._head
        head.write = 1
        self._slices.put(data)
        now = divmod(time.clock_gettime_ns(time.CLOCK_TAI), 1_000_000_000)
        for moment in (head.atime, head.writetime):
            moment.seconds, moment.nanoseconds = now
        head.cnt0 += 1
        self._slices.stamp()
        head.write = 0
        self._semaphores.post()

    def close(self) -> None:
        """See :meth:`~escape_hw.io.interchange.stream.Stream.close`; gives its semaphore back."""
        if self._memory.closed:
            return
        self._semaphores.release()
        # Views keep the memory from being unmapped.
        del self._head, self._slices, self._semaphores
        self._memory.close()

    def unlink(self) -> None:
        """Remove the image; processes that have opened it keep it."""
        layout.shm_path(self.name).unlink(missing_ok=True)


def _unix_ns(seconds: int, nanoseconds: int) -> int:
    """A time of milk's (international atomic time) as Unix time; 0 stays 0."""
    if seconds == 0:
        return 0
    ahead = time.clock_gettime_ns(time.CLOCK_TAI) - time.time_ns()
    # Both clocks were read one after the other; what differs is whole seconds, or nothing.
    return seconds * 1_000_000_000 + nanoseconds - round(ahead / 1e9) * 1_000_000_000
