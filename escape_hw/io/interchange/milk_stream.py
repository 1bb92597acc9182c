"""Shared-memory images of milk and CACAO, read and written without their library."""

from __future__ import annotations

import contextlib
import mmap
import os
import time
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from escape_hw.errors import ProductError
from escape_hw.io.interchange import milk_layout as layout
from escape_hw.io.interchange.milk_semaphores import Semaphores
from escape_hw.io.interchange.milk_slices import Slices
from escape_hw.io.interchange.stream import Publication, StreamLost
from escape_hw.io.storage import storage_error

#: Seconds between looks at the counter where no semaphore is free, and before a torn read is given up.
_LOOK_S, _TORN_S = 5e-5, 1.0
#: milk makes its images readable and writable for everybody, whatever the umask.
_MODE = 0o666


class MilkStream:
    """An open image; see :class:`~escape_hw.io.interchange.stream.Stream`.

    Made by :meth:`open` or :meth:`create`. A reader waits on one of the image's semaphores, which it marks
    as its own and gives back on closing. Of a circular buffer, the arrays are its slices.

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
        self.dtype: DTypeLike = layout.DTYPES[self._head.datatype]
        sections = layout.found_sections(self._head, len(memory))
        if sections is None:
            raise ValueError(f"image '{name}': {layout.problem_of(self._head, len(memory))}")
        self._slices = Slices(memory, self._head, sections)
        self.shape = self._slices.shape
        self._semaphores = Semaphores(memory, sections, self._head.sem)

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

        Everybody may write to it, as to those that milk makes.

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
        # Nobody sees it before it is whole.
        draft = path.with_name(f"{path.name}.{os.getpid()}")
        try:
            draft.unlink(missing_ok=True)
            descriptor = os.open(draft, os.O_RDWR | os.O_CREAT | os.O_EXCL, _MODE)
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
            made = cls(name, memory)
            made._semaphores.initialise()
            made._slices.initialise()
            draft.replace(path)
        except OSError as error:
            with contextlib.suppress(OSError):
                draft.unlink(missing_ok=True)
            raise storage_error(path, error) from error
        return made

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
                data = self._slices.newest().copy()
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
            if not self._semaphores.wait(left):
                time.sleep(min(_LOOK_S, left))
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
        """Remove the image for everybody who has not opened it yet."""
        layout.shm_path(self.name).unlink(missing_ok=True)


def _unix_ns(seconds: int, nanoseconds: int) -> int:
    """A time of milk's (international atomic time) as Unix time; 0 stays 0."""
    if seconds == 0:
        return 0
    ahead = time.clock_gettime_ns(time.CLOCK_TAI) - time.time_ns()
    # Both clocks were read one after the other; what differs is whole seconds, or nothing.
    return seconds * 1_000_000_000 + nanoseconds - round(ahead / 1e9) * 1_000_000_000
