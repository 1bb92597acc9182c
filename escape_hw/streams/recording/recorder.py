"""Recording of streams at full rate.

The recorder is an ordinary reader of the rings, so that a slow or full disk does not delay the loop. Entries
that it read too late, or had no room for, are counted as dropped.
"""

from __future__ import annotations

import contextlib
import logging
import os
import queue
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.streams.recording.block_file import HEADER, SUFFIX, write_block
from escape_hw.streams.ring import RingReader, Sample
from escape_hw.supervision import BackgroundThread

log = logging.getLogger(__name__)

#: Size of a block in bytes, and the time after which a smaller one is written.
_BLOCK_BYTES, _BLOCK_S = 4 << 20, 1.0
#: Largest number of bytes that wait for the disk.
MAX_QUEUED_BYTES = 128 << 20
#: Polling period of rings without new entries, seconds.
_POLL_S = 0.0005
#: Free bytes on the disk below which a recording ends.
MIN_FREE_BYTES = 256 << 20


@dataclass(slots=True)
class RecordingProgress:
    """Progress of a recording.

    Parameters
    ----------
    written, dropped
        Entries on disk, and entries lost because the reader or the disk was too slow.
    size
        Bytes on disk.
    fault
        Why it ended without a request; empty while it runs.
    """

    written: int = 0
    dropped: int = 0
    size: int = 0
    fault: str = ""


@dataclass(slots=True, eq=False)
class _StreamBuffer:
    """Entries of one stream that are not in a block yet."""

    reader: RingReader
    file: IO[bytes]
    heads: list[tuple[int, int, int]] = field(default_factory=list)
    arrays: list[NDArray[Any]] = field(default_factory=list)
    size: int = 0
    since: float = 0.0

    def has_shape_of(self, sample: Sample) -> bool:
        """Whether an entry has the shape and type of the others."""
        first = self.arrays[0] if self.arrays else sample.data
        return first.shape == sample.data.shape and first.dtype == sample.data.dtype

    def add(self, sample: Sample) -> None:
        """Add an entry."""
        self.since = self.since if self.arrays else time.monotonic()
        self.heads.append((sample.index, sample.exposed_ns, sample.arrived_ns))
        self.arrays.append(sample.data)
        self.size += sample.data.nbytes

    def is_due(self) -> bool:
        """Whether the entries are large or old enough for a block."""
        return bool(self.arrays) and (self.size >= _BLOCK_BYTES or time.monotonic() - self.since > _BLOCK_S)


_Block = tuple[IO[bytes], list[tuple[int, int, int]], list[NDArray[Any]], int]


class StreamRecorder:
    """Writes streams to a folder until stopped; best in a process of its own.

    Parameters
    ----------
    folder
        Destination of ``NAME.blocks`` of each stream; read with
        :func:`~escape_hw.streams.recording.block_file.read_recording`.
    streams
        Segment by name of the stream.
    min_free_bytes
        Free bytes on the disk below which the recording ends.

    Raises
    ------
    StreamUnavailable
        A segment does not exist.
    OSError
        The folder cannot be written to.
    """

    def __init__(
        self, folder: Path, streams: Mapping[str, str], *, min_free_bytes: int = MIN_FREE_BYTES
    ) -> None:
        self.folder, self._min_free_bytes = folder, min_free_bytes
        self.state = RecordingProgress()
        self._queue: queue.SimpleQueue[_Block | None] = queue.SimpleQueue()
        self._queued_bytes, self._lock = 0, threading.Lock()
        folder.mkdir(parents=True, exist_ok=True)
        self._buffers: list[_StreamBuffer] = []
        with contextlib.ExitStack() as opened:
            for name, segment in streams.items():
                reader = opened.enter_context(RingReader(segment))
                reader.seek_newest()
                file = opened.enter_context(open(folder / f"{name}{SUFFIX}", "wb", buffering=0))
                self._buffers.append(_StreamBuffer(reader, file))
            self._opened = opened.pop_all()

    def run(
        self,
        is_stopped: Callable[[], bool],
        on_state: Callable[[RecordingProgress], object] = lambda state: None,
    ) -> RecordingProgress:
        """Record until ``is_stopped``, a full disk or the end of all streams; ``on_state`` gets the state."""
        writer = BackgroundThread("recorder", self._write)
        writer.start()
        next_report = 0.0
        with self._opened:
            try:
                while not is_stopped() and not self.state.fault:
                    if not self._read_new():
                        time.sleep(_POLL_S)
                    now = time.monotonic()
                    if now >= next_report:
                        next_report = now + _BLOCK_S
                        self._check_free_space()
                        on_state(self.state)
                        if not any(buffer.reader.alive for buffer in self._buffers):
                            break
                self._read_new()
                for buffer in self._buffers:
                    self._enqueue_block(buffer)
            finally:
                self._queue.put(None)
                writer.join()
        on_state(self.state)
        return self.state

    def _read_new(self) -> bool:
        """Read new entries; whether there were any."""
        new = False
        for buffer in self._buffers:
            missed = buffer.reader.missed
            # At most one ring, so that all streams are read in turn.
            for _ in range(buffer.reader.slots):
                sample = buffer.reader.next()
                if sample is None:
                    break
                new = True
                if not buffer.has_shape_of(sample):
                    self._enqueue_block(buffer)
                buffer.add(sample)
            self._count_dropped(buffer.reader.missed - missed)
            if buffer.is_due():
                self._enqueue_block(buffer)
        return new

    def _enqueue_block(self, buffer: _StreamBuffer) -> None:
        """Queue a block for the writer, or drop it when the queue is full."""
        if not buffer.arrays:
            return
        if self._queued_bytes + buffer.size > MAX_QUEUED_BYTES:
            self._count_dropped(len(buffer.arrays))
        else:
            with self._lock:
                self._queued_bytes += buffer.size
            self._queue.put((buffer.file, buffer.heads, buffer.arrays, buffer.size))
        buffer.heads, buffer.arrays, buffer.size = [], [], 0

    def _write(self) -> None:
        """Write blocks, in a thread; after a failure the rest is dropped and counted."""
        while (block := self._queue.get()) is not None:
            file, heads, arrays, size = block
            try:
                if self.state.fault:
                    self._count_dropped(len(arrays))
                else:
                    self.state.size += write_block(file, np.array(heads, HEADER), np.stack(arrays))
                    self.state.written += len(arrays)
            except OSError as error:
                self._count_dropped(len(arrays))
                self._stop_with_fault(f"{error.strerror or error}; free some space")
            finally:
                with self._lock:
                    self._queued_bytes -= size

    def _count_dropped(self, entries: int) -> None:
        with self._lock:
            self.state.dropped += entries

    def _check_free_space(self) -> None:
        disk = os.statvfs(self.folder)
        free = disk.f_bavail * disk.f_frsize
        if free < self._min_free_bytes:
            self._stop_with_fault(
                f"{free / 1e6:.0f} MB free, below the limit of {self._min_free_bytes / 1e6:.0f} MB; "
                "free some space"
            )

    def _stop_with_fault(self, why: str) -> None:
        self.state.fault = f"{self.folder}: {why}"
        log.error("recording ended: %s", self.state.fault)
