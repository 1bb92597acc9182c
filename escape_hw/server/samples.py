"""The newest entry of a stream, for clients on another host."""

from __future__ import annotations

from typing import Any

from escape_hw.streams.reader_shelf import ReaderShelf


class Samples:
    """Reads the engine's rings."""

    def __init__(self) -> None:
        self._readers = ReaderShelf()

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
        reader = self._readers.reader(stream, segment)
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
        self._readers.close()
