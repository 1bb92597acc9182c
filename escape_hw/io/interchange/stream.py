"""What the streams of other software have in common: the newest array wins, and writes are counted."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

from numpy.typing import DTypeLike, NDArray


@dataclass(frozen=True, slots=True, eq=False)
class Publication:
    """One array of a stream, a copy.

    ``count`` is the number of the write, which rises by one with each; ``written_ns`` its Unix time in
    nanoseconds, 0 if the stream does not record it.
    """

    data: NDArray[Any]
    count: int
    written_ns: int


class Stream(Protocol):
    """An open stream of arrays of one shape and type."""

    @property
    def name(self) -> str:
        """Name."""
        ...

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of its arrays, rows first."""
        ...

    @property
    def dtype(self) -> DTypeLike:
        """Type of its elements."""
        ...

    @property
    def count(self) -> int:
        """Number of the newest write."""
        ...

    def latest(self) -> Publication:
        """The newest array.

        Raises
        ------
        StreamReadError
            Its writer died halfway through it.
        """
        ...

    def read_after(self, count: int, timeout_s: float) -> Publication | None:
        """The newest array once it is newer than write number ``count``; ``None`` after a time limit.

        Raises
        ------
        StreamReadError
            Its writer died halfway through it.
        """
        ...

    def write(self, data: NDArray[Any]) -> None:
        """Publish an array of the stream's shape; elements are converted to its type.

        Raises
        ------
        ValueError
            The array has another shape.
        """
        ...

    def close(self) -> None:
        """Let go of it; the stream itself stays."""
        ...


class StreamReadError(Exception):
    """A stream's newest array cannot be read without tearing."""
