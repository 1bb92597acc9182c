"""One entry of a stream."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from escape_hw.api.brief import brief


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
    __repr__ = brief
