"""Rows of benchmarks from times in seconds."""

from __future__ import annotations

from typing import Literal

from escape_hw.api.benchmark import BenchmarkRow

_PER_SECOND = {"s": 1.0, "ms": 1e3, "us": 1e6}


def time_row(
    stage: str,
    seconds: tuple[float, float | None],
    peer_name: str,
    unit: Literal["s", "ms", "us"],
    note: str = "",
    floor: float | None = None,
) -> BenchmarkRow:
    """The times of ours and of the peer (``None``: not measured) as a row in ``unit``; so is ``floor``."""
    ours, peer = (None if value is None else value * _PER_SECOND[unit] for value in seconds)
    assert ours is not None
    return BenchmarkRow(stage, ours, peer, peer_name, unit, "lower", note, floor)


def frame_rate_row(
    stage: str, seconds: tuple[float, float | None], peer_name: str, note: str
) -> BenchmarkRow:
    """The times per frame of ours and of the peer as a row in frames per second."""
    ours, peer = seconds
    return BenchmarkRow(stage, 1 / ours, 1 / peer if peer else None, peer_name, "frame/s", "higher", note)
