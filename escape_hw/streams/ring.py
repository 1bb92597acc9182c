"""Rings of arrays in shared memory: one writer, any number of readers, no waiting."""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Mapping
from dataclasses import dataclass
from types import TracebackType
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
    """One entry of a stream, copied out of its memory.

    Parameters
    ----------
    index
        Number of the entry; of frame streams the frame's index.
    exposed_ns, arrived_ns
        When it was taken and when it was written, monotonic nanoseconds.
    data
        The entry's own array.
    meta
        Short description of the entry: ``{"stage": ..., "frames": ...}``.
    """

    index: int
    exposed_ns: int
    arrived_ns: int
    data: NDArray[Any]
    meta: Mapping[str, float | str]
    __repr__ = short_repr


#: How often a reader that was overtaken while it copied tries again.
_TRIES = 16
_NO_META: Mapping[str, float | str] = {}


@dataclass(frozen=True, slots=True, eq=False)
class RingStats:
    """What a ring tells of itself.

    Parameters
    ----------
    written
        Entries written since it was made.
    index, shape, dtype, arrived_ns
        Of the newest entry; an empty shape, ``""`` and 0 before the first.
    intervals
        How often the spacing of two entries fell in each bin of
        :mod:`~escape_hw.streams.timing` ``(BINS,)``; the difference of two such counts is the
        time between.
    closed
        Whether the writer has said goodbye.
    """

    name: str
    pid: int
    slots: int
    capacity: int
    written: int
    index: int
    shape: tuple[int, ...]
    dtype: str
    arrived_ns: int
    intervals: NDArray[np.uint64]
    closed: bool


class RingReader:
    """The reading end of a stream.

    Parameters
    ----------
    name
        The segment's name.

    Attributes
    ----------
    missed
        Entries that :meth:`next` found overwritten.

    Raises
    ------
    StreamGone
        There is no such ring.
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
            raise StreamUnavailable(f"{name} has not the size that its header tells; restart its server")
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
        """Whether the writer has said goodbye."""
        return bool(self._words[layout.CLOSED])

    @property
    def alive(self) -> bool:
        """Whether the writer has not said goodbye and its process lives; reads a file of the system."""
        return not self.closed and is_alive(self.pid, self._started)

    def latest(self, after: int = -1) -> Sample | None:
        """The newest entry.

        Parameters
        ----------
        after
            Index of the entry that the caller has; ``None`` is returned while it is the newest.
            After a restart of the camera indices begin anew, so that another index counts as newer,
            be it smaller.
        """
        for _ in range(_TRIES):
            count = self.written
            if count == 0:
                return None
            number = count - 1
            if self._index(number) == after:
                if self.written == count:
                    return None
                # One more was written meanwhile.
                continue
            sample = self._copy(number)
            if sample is not None:
                return sample
        return None

    def next(self) -> Sample | None:
        """The entry after the one this method gave before, the oldest at first; ``None``: not yet there.

        Entries that were overwritten before they could be read are counted in :attr:`missed`.
        """
        for _ in range(_TRIES):
            count = self.written
            if self._next >= count:
                return None
            # The slot of the oldest entry is the next to be written to.
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
        """Sleep until an entry is written.

        Parameters
        ----------
        after
            What :attr:`written` was when the caller looked.
        timeout_s
            Longest sleep.

        Returns
        -------
        bool
            Whether there is one; false when the time is up or the ring was closed.
        """
        until = time.monotonic() + timeout_s
        while self.written == after and not self.closed:
            left = until - time.monotonic()
            if left <= 0:
                return False
            futex_wait(self._futex, after & 0xFFFFFFFF, left)
        return self.written != after

    @property
    def written_at(self) -> int:
        """Address of the word of 64 bits that counts the entries."""
        return self._futex - self._futex % 8

    @property
    def position(self) -> int:
        """Number of the entry that :meth:`next` gives next, counted from 0 over the life of the ring."""
        return self._next

    def seek(self, number: int) -> None:
        """Let :meth:`next` go on with an entry by its number."""
        self._next = number

    def seek_newest(self) -> None:
        """Let :meth:`next` begin with what is written from now on."""
        self.seek(self.written)

    def stats(self) -> RingStats:
        """What the ring tells of itself, without copying an entry."""
        count = self.written
        entry = self._entry(count - 1) if count else (0,) * 12
        index, arrived, code, dimensions = entry[0], entry[2], entry[4], entry[5]
        shape = entry[8 : 8 + min(dimensions, layout.MAX_DIMENSIONS)]
        dtype = layout.DTYPES[code % len(layout.DTYPES)].str[1:] if count else ""
        intervals = np.array(self._words[layout.INTERVALS : layout.INTERVALS + BINS], dtype=np.uint64)
        return RingStats(
            self.name, self.pid, self.slots, self.capacity, count, index, shape, dtype, arrived, intervals,
            self.closed,
        )  # fmt: skip

    def close(self) -> None:
        """Let go of the memory; the ring lives on."""
        self._words.release()
        self._memory.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _at(self, number: int) -> int:
        return layout.HEADER_BYTES + (number % self.slots) * self._stride

    def _entry(self, number: int) -> tuple[int, ...]:
        entry: tuple[int, ...] = layout.ENTRY.unpack_from(self._memory, self._at(number) + layout.ENTRY_AT)
        return entry

    def _index(self, number: int) -> int:
        return int(self._entry(number)[0])

    def _copy(self, number: int) -> Sample | None:
        """An entry by its number, or ``None`` when it was overwritten before or meanwhile."""
        at = self._at(number)
        word = at >> 3
        if self._words[word + layout.ENDED] != number + 1:
            return None
        entry = self._entry(number)
        index, exposed, arrived, size, code, dimensions, meta_bytes = entry[:7]
        # What is being overwritten may say anything.
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
    """One open reader for each stream that was looked at, exchanged when its segment is another one."""

    def __init__(self) -> None:
        self._readers: dict[str, RingReader] = {}

    def reader(self, stream: str, segment: str | None) -> RingReader | None:
        """The reader of a stream that lies in a segment; ``None`` where there is none."""
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
        """Let go of the rings."""
        for reader in self._readers.values():
            reader.close()
        self._readers.clear()


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
        """A slot's payload as an array like ``data``; made once while the shape stays."""
        view = self._views[slot]
        if view is not None and view.shape == data.shape and view.dtype == data.dtype:
            return view
        if not self._open:
            raise StreamUnavailable(f"{self.name}: written to after it was closed")
        if data.nbytes > self.capacity or data.ndim > layout.MAX_DIMENSIONS:
            raise ValueError(
                f"{self.name}: an array {data.shape} of {data.dtype} does not fit; "
                f"{self.capacity} bytes and {layout.MAX_DIMENSIONS} dimensions are the most"
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
            futex_wake(self._futex)
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
