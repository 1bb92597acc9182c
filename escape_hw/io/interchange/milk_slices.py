"""The data of an image of milk's: one array, or slices that are written in turn, and a ring of copies."""

from __future__ import annotations

import mmap
from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.io.interchange import milk_layout as layout


class Slices:
    """Where the newest array of an image lies, and where the next one goes.

    Parameters
    ----------
    memory
        The whole file.
    head
        Its metadata, in place.
    sections
        Where its sections begin.
    """

    def __init__(self, memory: mmap.mmap, head: layout.Metadata, sections: layout.Sections) -> None:
        whole, dtype = layout.shape_of(head), layout.DTYPES[head.datatype]
        self._head, self._circular = head, layout.is_circular(head)
        self.shape = whole[1:] if self._circular else whole
        self._n = whole[0] if self._circular else 1
        self._data: NDArray[Any] = np.ndarray((self._n, *self.shape), dtype, memory, sections.data)
        self._ring: NDArray[Any] = np.ndarray(
            (head.ring_size, self._n, *self.shape), dtype, memory, sections.ring
        )
        n = self._n if layout.is_stamped(head) else 0
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
        newest: NDArray[Any] = self._data[self._head.cnt1 % self._n if self._circular else 0]
        return newest

    def put(self, data: NDArray[Any]) -> None:
        """Write an array; readers see it once the metadata say so."""
        head = self._head
        self._data[self._next()] = data
        if head.ring_size:
            place = head.ring_index + 1
            if place >= head.ring_size:
                place, head.ring_cycle = 0, head.ring_cycle + 1
            self._ring[place] = self._data
            head.ring_index = place

    def stamp(self) -> None:
        """Make the array that was put the newest, with the times and the count of the metadata."""
        if not self._circular:
            return
        head, place = self._head, self._next()
        if len(self._counts):
            self._acquired[place] = head.atime.seconds, head.atime.nanoseconds
            self._written[place] = head.writetime.seconds, head.writetime.nanoseconds
            self._counts[place] = head.cnt0
        head.cnt1 = place

    def _next(self) -> int:
        return (self._head.cnt1 + 1) % self._n if self._circular else 0
