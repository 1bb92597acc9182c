"""Readers of a server's streams, kept open between two looks."""

from __future__ import annotations

from escape_hw.streams.ring_reader import RingReader
from escape_hw.streams.segments import StreamGone


class ReaderShelf:
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
        except StreamGone:
            return None
        return self._readers[stream]

    def close(self) -> None:
        """Let go of the rings."""
        for reader in self._readers.values():
            reader.close()
        self._readers.clear()
