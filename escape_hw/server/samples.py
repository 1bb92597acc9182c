"""The newest entry of a stream, for clients on another host."""

from __future__ import annotations

from typing import Any

from escape_hw.streams.ring import RingReader
from escape_hw.streams.segments import StreamGone


class Samples:
    """Reads the engine's rings."""

    def __init__(self) -> None:
        self._readers: dict[str, RingReader] = {}

    def newest(
        self, stream: str, segment: str | None, after: int
    ) -> tuple[dict[str, Any] | None, bytes | None]:
        """Head and bytes of a stream's newest entry; nothing when there is none newer than ``after``.

        Parameters
        ----------
        stream
            Its name.
        segment
            Where it lies; ``None``: nowhere yet.
        after
            Index of the entry that the client has.
        """
        reader = self._reader(stream, segment)
        sample = None if reader is None else reader.latest(after)
        if sample is None:
            return None, None
        head = {
            "index": sample.index, "exposed_ns": sample.exposed_ns, "arrived_ns": sample.arrived_ns,
            "dtype": sample.data.dtype.str, "shape": list(sample.data.shape), "meta": dict(sample.meta),
        }  # fmt: skip
        return head, sample.data.tobytes()

    def close(self) -> None:
        """Let go of the rings."""
        for reader in self._readers.values():
            reader.close()
        self._readers.clear()

    def _reader(self, stream: str, segment: str | None) -> RingReader | None:
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
