"""The reading end of a ring: it only looks, and copies what it found whole."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import NDArray

from escape_hw.streams import layout, segments
from escape_hw.streams.histogram import BINS
from escape_hw.streams.sample import Sample
from escape_hw.streams.segments import StreamGone
from escape_hw.streams.wakeup import alarm_in, sleep_on

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
        :mod:`~escape_hw.streams.histogram` ``(BINS,)``; the difference of two such counts is the
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
            raise StreamGone(f"{name} has not the size that its header tells; restart its server")
        self._words = memoryview(self._memory).cast("Q")
        self._alarm = alarm_in(self._memory, layout.WRITTEN)
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
        return not self.closed and segments.process_start(self.pid) == self._started

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
            sleep_on(self._alarm, after & 0xFFFFFFFF, left)
        return self.written != after

    @property
    def written_at(self) -> int:
        """Address of the word of 64 bits that counts the entries."""
        return self._alarm - self._alarm % 8

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
        shape = entry[8 : 8 + min(dimensions, layout.MOST_DIMENSIONS)]
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
        if size > self.capacity or code >= len(layout.DTYPES) or dimensions > layout.MOST_DIMENSIONS:
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
