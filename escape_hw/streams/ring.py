"""Rings of arrays in shared memory: one writer, any number of readers, no waiting.

A torn read, of an entry that the writer overwrites meanwhile, is detected by the entry's counter and
repeated.
"""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.representation import short_repr
from escape_hw.streams import layout, segments
from escape_hw.streams.futex import futex_address, futex_wait, futex_wake
from escape_hw.streams.segments import StreamUnavailable
from escape_hw.streams.timing import BINS, bin_of
from escape_hw.supervision import is_alive


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """One entry of a stream, copied from shared memory.

    Parameters
    ----------
    index
        Number of the entry; of frame streams the frame's index.
    exposed_ns, arrived_ns
        Times of exposure and of writing, monotonic nanoseconds.
    data
        Array.
    meta
        Short description of the entry: ``{"stage": ..., "frames": ...}``.
    """

    index: int
    exposed_ns: int
    arrived_ns: int
    data: NDArray[Any]
    meta: Mapping[str, float | str]
    __repr__ = short_repr


#: Attempts to copy an entry while the writer overwrites it.
_TRIES = 16
_NO_META: Mapping[str, float | str] = {}


@dataclass(frozen=True, slots=True, eq=False)
class RingStats:
    """Statistics of a ring.

    Parameters
    ----------
    written
        Entries written since its creation.
    shape, dtype, arrived_ns
        Of the newest entry; an empty shape, ``""`` and 0 before the first.
    intervals
        Histogram of the intervals between entries in the bins of :mod:`~escape_hw.streams.timing`
        ``(BINS,)``, since its creation.
    """

    written: int
    shape: tuple[int, ...]
    dtype: str
    arrived_ns: int
    intervals: NDArray[np.uint64]


class RingReader:
    """Reader of the stream in a segment.

    Attributes
    ----------
    missed
        Entries that were overwritten before :meth:`next` read them.

    Raises
    ------
    StreamUnavailable
        The ring does not exist.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self._memory = segments.attach(name)
        _, _, self.pid, self._started = segments.IDENTITY.unpack_from(self._memory)
        geometry: tuple[int, int] = layout.GEOMETRY.unpack_from(self._memory, segments.IDENTITY.size)
        self.slots, self.capacity = geometry
        self._stride = layout.slot_bytes(self.capacity)
        if len(self._memory) != layout.HEADER_BYTES + self.slots * self._stride:
            self._memory.close()
            raise StreamUnavailable(f"{name} does not have the size in its header; restart its server")
        self._words = memoryview(self._memory).cast("Q")
        self._futex = futex_address(self._memory, layout.WRITTEN)
        self._next = 0
        self.missed = 0

    @property
    def written(self) -> int:
        """Entries written so far."""
        return self._words[layout.WRITTEN]

    @property
    def closed(self) -> bool:
        """Whether the writer has closed the ring."""
        return bool(self._words[layout.CLOSED])

    @property
    def alive(self) -> bool:
        """Whether the ring is not closed and the writer's process is alive; reads a system file."""
        return not self.closed and is_alive(self.pid, self._started)

    def latest(self, after: int = -1) -> Sample | None:
        """The newest entry; ``None`` if it is the one with the index ``after``, which the caller has.

        A smaller index counts as newer as well, since indices start again after a restart of the camera.
        """
        for _ in range(_TRIES):
            count = self.written
            if count == 0:
                return None
            number = count - 1
            if self._entry(number)[0] == after:
                if self.written == count:
                    return None
                continue  # another entry was written meanwhile
            sample = self._copy(number)
            if sample is not None:
                return sample
        return None

    def next(self) -> Sample | None:
        """The next entry in order, the oldest at first; ``None`` when there is none yet.

        Entries that were overwritten before they could be read are counted in :attr:`missed`.
        """
        for _ in range(_TRIES):
            count = self.written
            if self._next >= count:
                return None
            # The slot of the oldest entry is written next.
            oldest = max(0, count - self.slots + 1)
            if self._next < oldest:
                self.missed += oldest - self._next
                self._next = oldest
            sample = self._copy(self._next)
            if sample is not None:
                self._next += 1
                return sample
        return None

    def wait(self, after: int, timeout_s: float) -> bool:
        """Wait until :attr:`written` differs from ``after``; false after the time-out or at its end."""
        until = time.monotonic() + timeout_s
        while self.written == after and not self.closed:
            left = until - time.monotonic()
            if left <= 0:
                return False
            futex_wait(self._futex, after & 0xFFFFFFFF, left)
        return self.written != after

    @property
    def written_at(self) -> int:
        """Address of the 64-bit counter of the entries."""
        return self._futex - self._futex % 8

    @property
    def position(self) -> int:
        """Number of the entry that :meth:`next` returns next, counted from 0 since creation."""
        return self._next

    def seek(self, number: int) -> None:
        """Let :meth:`next` continue with this entry number."""
        self._next = number

    def seek_newest(self) -> None:
        """Let :meth:`next` continue with entries that are written from now on."""
        self.seek(self.written)

    def stats(self) -> RingStats:
        """Statistics, without copying an entry."""
        count = self.written
        entry = self._entry(count - 1) if count else (0,) * 12
        arrived, code, dimensions = entry[2], entry[4], entry[5]
        shape = entry[8 : 8 + min(dimensions, layout.MAX_DIMENSIONS)]
        dtype = layout.DTYPES[code % len(layout.DTYPES)].str[1:] if count else ""
        intervals = np.array(self._words[layout.INTERVALS : layout.INTERVALS + BINS], dtype=np.uint64)
        return RingStats(count, shape, dtype, arrived, intervals)

    def close(self) -> None:
        """Unmap the memory; the ring stays."""
        self._words.release()
        self._memory.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def _at(self, number: int) -> int:
        return layout.HEADER_BYTES + (number % self.slots) * self._stride

    def _entry(self, number: int) -> tuple[int, ...]:
        return layout.ENTRY.unpack_from(self._memory, self._at(number) + layout.ENTRY_AT)

    def _copy(self, number: int) -> Sample | None:
        """Copy an entry by its number; ``None`` when it was overwritten."""
        at = self._at(number)
        word = at >> 3
        if self._words[word + layout.ENDED] != number + 1:
            return None
        entry = self._entry(number)
        index, exposed, arrived, size, code, dimensions, meta_bytes = entry[:7]
        # An entry that is being overwritten may contain any values.
        if size > self.capacity or code >= len(layout.DTYPES) or dimensions > layout.MAX_DIMENSIONS:
            return None
        dtype, shape = layout.DTYPES[code], entry[8 : 8 + dimensions]
        if min(shape, default=0) < 0 or math.prod(shape) * dtype.itemsize != size:
            return None
        start = at + layout.SLOT_HEADER_BYTES
        data = np.ndarray(shape, dtype, self._memory, start).copy()
        meta = bytes(
            self._memory[at + layout.META_AT : at + layout.META_AT + min(meta_bytes, layout.META_BYTES)]
        )
        if self._words[word + layout.BEGAN] != number + 1:
            return None
        return Sample(index, exposed, arrived, data, json.loads(meta) if meta else _NO_META)


class ReaderCache:
    """One open reader per stream, replaced when the stream's segment changes."""

    def __init__(self) -> None:
        self._readers: dict[str, RingReader] = {}

    def reader(self, stream: str, segment: str | None) -> RingReader | None:
        """The reader of a stream in a segment; ``None`` when it is not available."""
        known = self._readers.get(stream)
        if known is not None and known.name == segment and not known.closed:
            return known
        if known is not None:
            del self._readers[stream]
            known.close()
        if segment is None:
            return None
        try:
            self._readers[stream] = RingReader(segment)
        except StreamUnavailable:
            return None
        return self._readers[stream]

    def close(self) -> None:
        """Close all readers."""
        for reader in self._readers.values():
            reader.close()
        self._readers.clear()


#: Default number of entries of a ring.
SLOTS = 8


class RingWriter:
    """Writer of a stream, for one thread of one process.

    Parameters
    ----------
    name
        See :func:`~escape_hw.streams.segments.segment_name`.
    capacity_bytes
        Size of the largest array, bytes.
    slots
        Number of entries. A reader must copy an entry before ``slots - 1`` further ones are written.

    Raises
    ------
    StorageError
        Shared memory is not available.
    """

    def __init__(self, name: str, capacity_bytes: int, slots: int = SLOTS) -> None:
        if capacity_bytes < 1 or slots < 2:
            raise ValueError(
                f"{slots} slots of {capacity_bytes} bytes: a ring needs at least 2 slots of 1 byte"
            )
        self.name, self.capacity, self.slots = name, capacity_bytes, slots
        self._stride = layout.slot_bytes(capacity_bytes)
        size = layout.HEADER_BYTES + slots * self._stride
        self._memory = segments.create(name, size, layout.GEOMETRY, slots, capacity_bytes)
        self._words = memoryview(self._memory).cast("Q")
        self._futex = futex_address(self._memory, layout.WRITTEN)
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
        """Write a copy of an array; never blocks.

        Parameters
        ----------
        data
            Booleans, integers or floats, up to four dimensions and the capacity.
        index
            Index of the entry.
        exposed_ns, arrived_ns
            Times of exposure (0: unknown) and of writing (0: now), monotonic nanoseconds.
        meta
            JSON object of at most 256 bytes.

        Raises
        ------
        ValueError
            The array or the metadata does not fit; nothing is written.
        StreamUnavailable
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
        shape = data.shape + (0,) * (layout.MAX_DIMENSIONS - data.ndim)
        layout.ENTRY.pack_into(
            self._memory, at + layout.ENTRY_AT,
            index, exposed_ns, now, data.nbytes, self._codes[data.dtype], data.ndim, len(meta), 0, *shape,
        )  # fmt: skip
        if meta:
            start = at + layout.META_AT
            self._memory[start : start + len(meta)] = meta
        words[word + layout.ENDED] = number + 1
        words[layout.WRITTEN] = self._count = number + 1
        futex_wake(self._futex)
        if self._last_ns:
            words[layout.INTERVALS + bin_of(now - self._last_ns)] += 1
        self._last_ns = now

    def _view(self, slot: int, data: NDArray[Any]) -> NDArray[Any]:
        """The payload of a slot as an array like ``data``; cached while the shape stays."""
        view = self._views[slot]
        if view is not None and view.shape == data.shape and view.dtype == data.dtype:
            return view
        if not self._open:
            raise StreamUnavailable(f"{self.name}: the ring is closed")
        if data.nbytes > self.capacity or data.ndim > layout.MAX_DIMENSIONS:
            raise ValueError(
                f"{self.name}: an array {data.shape} of {data.dtype} does not fit; "
                f"at most {self.capacity} bytes and {layout.MAX_DIMENSIONS} dimensions"
            )
        if data.dtype not in self._codes:
            raise ValueError(f"{self.name}: arrays of {data.dtype} cannot be streamed")
        at = layout.HEADER_BYTES + slot * self._stride + layout.SLOT_HEADER_BYTES
        view = self._views[slot] = np.ndarray(data.shape, data.dtype, self._memory, at)
        return view

    def close(self) -> None:
        """Mark the ring as closed and remove the segment; may be repeated.

        A forked child of the writer's process does not remove it.
        """
        if not self._open:
            return
        self._open = False
        if os.getpid() == self._pid:
            self._words[layout.CLOSED] = 1
            futex_wake(self._futex)
            segments.remove(self.name)
        self._views = [None] * self.slots
        self._words.release()
        self._memory.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()
