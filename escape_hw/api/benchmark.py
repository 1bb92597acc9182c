"""Benchmarks against other packages: what a stage returns and how two codes are timed fairly."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import DTypeLike

from escape_hw.api.concurrency import limit_to_one_thread

Preference = Literal["higher", "lower"]


@dataclass(frozen=True, slots=True)
class BenchmarkRow:
    """One measurement of ours beside a peer's, made in the same run on the same machine.

    Parameters
    ----------
    stage
        Stage and measurement, such as ``optics: twin frames``.
    ours, peer
        The two figures, in ``unit``; ``peer`` is ``None`` where it could not be measured.
    peer_name
        Package, version and function that stand against us.
    unit
        Unit of both figures.
    better
        Which way is better.
    note
        Agreement of the results, or why there is no peer.
    floor
        What this machine could do at best, in ``unit``: the arithmetic that cannot be avoided at the
        speed of its fastest matrix products, or the memory traffic; ``None`` where not counted.
    """

    stage: str
    ours: float
    peer: float | None
    peer_name: str
    unit: str
    better: Preference
    note: str = ""
    floor: float | None = None

    @property
    def reached(self) -> float | None:
        """Share of the floor that ours reaches, at most 1."""
        if self.floor is None or self.floor == 0 or self.ours == 0:
            return None
        return self.ours / self.floor if self.better == "higher" else self.floor / self.ours

    @property
    def ratio(self) -> float | None:
        """How many times better ours is; below 1 it is worse."""
        if self.peer is None or self.peer == 0 or self.ours == 0:
            return None
        return self.ours / self.peer if self.better == "higher" else self.peer / self.ours

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON, the ratio and the share of the floor included."""
        return {**asdict(self), "ratio": self.ratio, "reached": self.reached}


#: What an entry point of the group ``escape.benchmarks`` is: a function that measures.
Benchmark = Callable[[], list[BenchmarkRow]]


def time_alternately(
    ours: Callable[[], object], peer: Callable[[], object] | None, *, seconds: float = 1.0, rounds: int = 7
) -> tuple[float, float | None]:
    """Median seconds per call of two functions timed in turn.

    Both are called once beforehand, so that compilation and caches do not count. Turns are short and
    alternate, so that what else the machine does falls on both alike.

    Parameters
    ----------
    ours, peer
        The two functions; without a peer only ours is timed.
    seconds
        Wall-clock time to spend on each, about.
    rounds
        Turns of each.
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


def product_rate(dtype: DTypeLike = np.float32, size: int = 512) -> float:
    """Floating-point operations per second of a large matrix product, for floors.

    Parameters
    ----------
    dtype
        Precision.
    size
        Rows and columns of the square factors.
    """
    a = np.ones((size, size), dtype)
    times = [_elapsed(lambda: a @ a, 1) for _ in range(9)]
    return 2 * size**3 / min(times)


def _elapsed(call: Callable[[], object], repeats: int) -> float:
    start = time.perf_counter()
    for _ in range(repeats):
        call()
    return time.perf_counter() - start


@contextmanager
def single_thread() -> Iterator[None]:
    """Hold the linear-algebra libraries to one thread, for thread pools fight and hide the cost."""
    with limit_to_one_thread():
        yield
