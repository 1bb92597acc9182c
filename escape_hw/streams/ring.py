"""Rings of arrays in shared memory: one process writes, any number read, nobody waits.

A reader only looks: its end, however violent, changes nothing for the writer or other readers.
"""

from __future__ import annotations

import os
import time
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from escape_hw.streams import layout, segments
from escape_hw.streams.histogram import bin_of
from escape_hw.streams.ring_reader import RingReader, RingStats
from escape_hw.streams.segments import StreamGone
from escape_hw.streams.wakeup import alarm_in, wake

__all__ = ["SLOTS", "RingReader", "RingStats", "RingWriter"]

#: Entries that a ring keeps.
SLOTS = 8


class RingWriter:
    """The writing end of a stream; for one thread of one process.

    Parameters
    ----------
    name
        See :func:`~escape_hw.streams.segments.segment_name`.
    capacity_bytes
        Size of the largest array.
    slots
        Entries kept. A reader has the time of this many entries, less one, to copy the newest.

    Raises
    ------
    StorageError
        The memory is not to be had.
    """

    def __init__(self, name: str, capacity_bytes: int, slots: int = SLOTS) -> None:
        if capacity_bytes < 1 or slots < 2:
            raise ValueError(f"a ring of {slots} slots of {capacity_bytes} bytes is none")
        self.name, self.capacity, self.slots = name, capacity_bytes, slots
        self._stride = layout.slot_bytes(capacity_bytes)
        size = layout.HEADER_BYTES + slots * self._stride
        self._memory = segments.create(name, size, layout.GEOMETRY, slots, capacity_bytes)
        self._words = memoryview(self._memory).cast("Q")
        self._alarm = alarm_in(self._memory, layout.WRITTEN)
        self._count, self._last_ns, self._pid = 0, 0, os.getpid()
        self._codes = {dtype: code for code, dtype in enumerate(layout.DTYPES)}
        self._views: list[NDArray[Any] | None] = [None] * slots
        self._open = True

    @property
    def written(self) -> int:
        """Entries written so far."""
        return self._count

    def write(
        self, data: NDArray[Any], index: int, exposed_ns: int = 0, arrived_ns: int = 0, meta: bytes = b""
    ) -> None:
        """Publish an array; takes a copy and never waits.

        Parameters
        ----------
        data
            At most four dimensions of booleans, integers or floats, at most the capacity.
        index
            Number of the entry, for its readers.
        exposed_ns, arrived_ns
            When it was taken and when it is written, monotonic nanoseconds; 0: unknown, and now.
        meta
            JSON object of at most 256 bytes.

        Raises
        ------
        ValueError
            The array or the meta does not fit the ring; nothing is written.
        StreamGone
            The ring is closed.
        """
        number = self._count
        slot = number % self.slots
        view = self._view(slot, data)
        if len(meta) > layout.META_BYTES:
            raise ValueError(f"{self.name}: {len(meta)} bytes of meta, at most {layout.META_BYTES} fit")
        now = arrived_ns or time.monotonic_ns()
        at = layout.HEADER_BYTES + slot * self._stride
        words, word = self._words, at >> 3
        words[word + layout.BEGAN] = number + 1
        np.copyto(view, data, casting="no")
        shape = data.shape + (0,) * (layout.MOST_DIMENSIONS - data.ndim)
        layout.ENTRY.pack_into(
            self._memory, at + layout.ENTRY_AT,
            index, exposed_ns, now, data.nbytes, self._codes[data.dtype], data.ndim, len(meta), 0, *shape,
        )  # fmt: skip
        if meta:
            start = at + layout.META_AT
            self._memory[start : start + len(meta)] = meta
        words[word + layout.ENDED] = number + 1
        words[layout.WRITTEN] = self._count = number + 1
        wake(self._alarm)
        if self._last_ns:
            words[layout.INTERVALS + bin_of(now - self._last_ns)] += 1
        self._last_ns = now

    def _view(self, slot: int, data: NDArray[Any]) -> NDArray[Any]:
        """A slot's payload as an array like ``data``; made once while the shape stays."""
        view = self._views[slot]
        if view is not None and view.shape == data.shape and view.dtype == data.dtype:
            return view
        if not self._open:
            raise StreamGone(f"{self.name}: written to after it was closed")
        if data.nbytes > self.capacity or data.ndim > layout.MOST_DIMENSIONS:
            raise ValueError(
                f"{self.name}: an array {data.shape} of {data.dtype} does not fit; "
                f"{self.capacity} bytes and {layout.MOST_DIMENSIONS} dimensions are the most"
            )
        if data.dtype not in self._codes:
            raise ValueError(f"{self.name}: arrays of {data.dtype} cannot be streamed")
        at = layout.HEADER_BYTES + slot * self._stride + layout.SLOT_HEADER_BYTES
        view = self._views[slot] = np.ndarray(data.shape, data.dtype, self._memory, at)
        return view

    def close(self) -> None:
        """Say goodbye to the readers and remove the segment; may be repeated.

        A process that was forked off the writer's own does not remove it.
        """
        if not self._open:
            return
        self._open = False
        if os.getpid() == self._pid:
            self._words[layout.CLOSED] = 1
            wake(self._alarm)
            segments.remove(self.name)
        self._views = [None] * self.slots
        self._words.release()
        self._memory.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
