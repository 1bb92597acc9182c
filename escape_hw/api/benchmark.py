"""Benchmarks against other packages: result rows and timing of two functions in turn."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np


@dataclass(frozen=True, slots=True)
class BenchmarkRow:
    """One measurement of ESCAPE and of another package, in the same run on the same machine.

    Parameters
    ----------
    stage
        Stage and measurement, for example ``optics: twin frames``.
    ours, peer
        Values of ESCAPE and of the other package, in ``unit``; ``peer`` is ``None`` if not measured.
    peer_name
        Package, version and function of the peer.
    unit
        Unit of both values.
    better
        Whether a higher or a lower value is better.
    note
        Agreement of the results, or why there is no peer.
    floor
        Best possible value on this machine, in ``unit``, from the minimum number of operations at the
        speed of its matrix products, or from the memory traffic; ``None`` if not computed.
    """

    stage: str
    ours: float
    peer: float | None
    peer_name: str
    unit: str
    better: Literal["higher", "lower"]
    note: str = ""
    floor: float | None = None

    @property
    def reached(self) -> float | None:
        """Ratio of ``ours`` to the floor, in (0, 1]; ``None`` without a floor."""
        return self._relative_to(self.floor)

    @property
    def ratio(self) -> float | None:
        """Factor by which ``ours`` is better than ``peer``; below 1 it is worse."""
        return self._relative_to(self.peer)

    def _relative_to(self, other: float | None) -> float | None:
        if not other or not self.ours:
            return None
        return self.ours / other if self.better == "higher" else other / self.ours

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON, with ``ratio`` and ``reached``."""
        return {**asdict(self), "ratio": self.ratio, "reached": self.reached}


#: Type of an entry point of the group ``escape.benchmarks``.
Benchmark = Callable[[], list[BenchmarkRow]]


def time_alternately(
    ours: Callable[[], object], peer: Callable[[], object] | None, *, seconds: float = 1.0, rounds: int = 7
) -> tuple[float, float | None]:
    """Median seconds per call of two functions, timed in turn.

    Both are called once before timing, to exclude compilation. Short alternating rounds distribute other
    load of the machine evenly.

    Parameters
    ----------
    ours, peer
        The two functions; without a peer only ``ours`` is timed.
    seconds
        Approximate wall-clock time per function.
    rounds
        Number of rounds per function.
    """
    both = [f for f in (ours, peer) if f is not None]
    repeats = []
    for call in both:
        once = _elapsed(call, 1)
        if once < seconds:
            once = _elapsed(call, 1)
        repeats.append(max(1, round(seconds / rounds / max(once, 1e-7))))
    times: list[list[float]] = [[] for _ in both]
    for _ in range(rounds):
        for k, call in enumerate(both):
            times[k].append(_elapsed(call, repeats[k]) / repeats[k])
    medians = [float(np.median(t)) for t in times]
    return medians[0], medians[1] if peer is not None else None


def product_rate(size: int = 512) -> float:
    """Floating-point operations per second of a single-precision product of two ``(size, size)`` matrices."""
    a = np.ones((size, size), np.float32)
    times = [_elapsed(lambda: a @ a, 1) for _ in range(9)]
    return 2 * size**3 / min(times)


def _elapsed(call: Callable[[], object], repeats: int) -> float:
    start = time.perf_counter()
    for _ in range(repeats):
        call()
    return time.perf_counter() - start
