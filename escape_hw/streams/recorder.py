"""Telemetry at full rate to disk: every entry of some streams, by a process that nobody waits for.

The recorder reads rings as any other reader does, so that a slow or full disk cannot hold up the loop:
what it did not get in time, or had no room for, is counted as dropped.
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

from escape_hw.streams.block_file import HEADER, SUFFIX, write_block
from escape_hw.streams.ring import RingReader
from escape_hw.streams.sample import Sample

log = logging.getLogger(__name__)

#: Bytes gathered before they are written, and seconds after which they are in any case.
_BLOCK_BYTES, _BLOCK_S = 4 << 20, 1.0
#: Bytes that may wait for the disk.
MOST_WAITING = 128 << 20
#: Seconds between two looks at rings that had nothing new.
_NAP_S = 0.0005
#: Bytes to leave on the disk for everybody else.
LEAST_FREE = 256 << 20


@dataclass(slots=True)
class Recorded:
    """How far a recording is.

    Parameters
    ----------
    written, dropped
        Entries on disk, and those that were not written because reader or disk were behind.
    size
        Bytes on disk.
    fault
        Why it ended by itself; empty while it runs.
    """

    written: int = 0
    dropped: int = 0
    size: int = 0
    fault: str = ""


@dataclass(slots=True, eq=False)
class _Track:
    """One stream on its way to its file."""

    reader: RingReader
    file: IO[bytes]
    heads: list[tuple[int, int, int]] = field(default_factory=list)
    arrays: list[NDArray[Any]] = field(default_factory=list)
    size: int = 0
    since: float = 0.0

    def fits(self, sample: Sample) -> bool:
        """Whether an entry is like those gathered."""
        first = self.arrays[0] if self.arrays else sample.data
        return first.shape == sample.data.shape and first.dtype == sample.data.dtype

    def add(self, sample: Sample) -> None:
        """Gather an entry."""
        self.since = self.since if self.arrays else time.monotonic()
        self.heads.append((sample.index, sample.exposed_ns, sample.arrived_ns))
        self.arrays.append(sample.data)
        self.size += sample.data.nbytes

    def due(self) -> bool:
        """Whether what was gathered is enough, or has waited long enough, for a block."""
        return bool(self.arrays) and (self.size >= _BLOCK_BYTES or time.monotonic() - self.since > _BLOCK_S)


_Block = tuple[IO[bytes], list[tuple[int, int, int]], list[NDArray[Any]], int]


class Recorder:
    """Writes streams to a folder until told to stop; best in a process of its own.

    Parameters
    ----------
    folder
        Gets ``NAME.blocks`` for each stream; see :func:`~escape_hw.streams.block_file.read_recording`.
    streams
        Segment by stream's name.
    least_free
        Bytes that stay free on the disk; the recording ends before.

    Raises
    ------
    StreamGone
        A segment is not there.
    OSError
        The folder cannot be written to.
    """

    def __init__(self, folder: Path, streams: Mapping[str, str], *, least_free: int = LEAST_FREE) -> None:
        self.folder, self._least_free = folder, least_free
        self.state = Recorded()
        self._waiting: queue.SimpleQueue[_Block | None] = queue.SimpleQueue()
        self._waiting_bytes, self._lock = 0, threading.Lock()
        folder.mkdir(parents=True, exist_ok=True)
        self._tracks: list[_Track] = []
        with contextlib.ExitStack() as opened:
            for name, segment in streams.items():
                reader = opened.enter_context(RingReader(segment))
                reader.seek_newest()
                file = opened.enter_context(open(folder / f"{name}{SUFFIX}", "wb", buffering=0))
                self._tracks.append(_Track(reader, file))
            self._opened = opened.pop_all()

    def run(
        self, stopped: Callable[[], bool], told: Callable[[Recorded], object] = lambda state: None
    ) -> Recorded:
        """Record until ``stopped``, a full disk, or the end of all streams; ``told`` hears once a second."""
        writer = threading.Thread(target=self._write, name="recorder", daemon=True)
        writer.start()
        next_word = 0.0
        with self._opened:
            try:
                while not stopped() and not self.state.fault:
                    if not self._pass():
                        time.sleep(_NAP_S)
                    now = time.monotonic()
                    if now >= next_word:
                        next_word = now + _BLOCK_S
                        self._look_at_disk()
                        told(self.state)
                        if not any(track.reader.alive for track in self._tracks):
                            break
                self._pass()
                for track in self._tracks:
                    self._hand_over(track)
            finally:
                self._waiting.put(None)
                writer.join()
        told(self.state)
        return self.state

    def _pass(self) -> bool:
        """Read what is new; whether anything was."""
        new = False
        for track in self._tracks:
            missed = track.reader.missed
            # At most a ring full, so that every stream gets its turn.
            for _ in range(track.reader.slots):
                sample = track.reader.next()
                if sample is None:
                    break
                new = True
                if not track.fits(sample):
                    self._hand_over(track)
                track.add(sample)
            self._count_dropped(track.reader.missed - missed)
            if track.due():
                self._hand_over(track)
        return new

    def _hand_over(self, track: _Track) -> None:
        """Give a block to the writer, unless too much waits there already."""
        if not track.arrays:
            return
        if self._waiting_bytes + track.size > MOST_WAITING:
            self._count_dropped(len(track.arrays))
        else:
            with self._lock:
                self._waiting_bytes += track.size
            self._waiting.put((track.file, track.heads, track.arrays, track.size))
        track.heads, track.arrays, track.size = [], [], 0

    def _write(self) -> None:
        """Write blocks; in a thread of its own. After a failure the rest is dropped, and counted."""
        while (block := self._waiting.get()) is not None:
            file, heads, arrays, size = block
            try:
                if self.state.fault:
                    self._count_dropped(len(arrays))
                else:
                    self.state.size += write_block(file, np.array(heads, HEADER), np.stack(arrays))
                    self.state.written += len(arrays)
            except OSError as error:
                self._count_dropped(len(arrays))
                self._end(f"{error.strerror or error}; free some space")
            finally:
                with self._lock:
                    self._waiting_bytes -= size

    def _count_dropped(self, entries: int) -> None:
        with self._lock:
            self.state.dropped += entries

    def _look_at_disk(self) -> None:
        disk = os.statvfs(self.folder)
        free = disk.f_bavail * disk.f_frsize
        if free < self._least_free:
            self._end(
                f"{free / 1e6:.0f} MB free, and {self._least_free / 1e6:.0f} MB are left to others; "
                "free some space"
            )

    def _end(self, why: str) -> None:
        self.state.fault = f"{self.folder}: {why}"
        log.error("recording ended: %s", self.state.fault)
