"""Threads of the linear-algebra libraries."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def one_thread() -> Iterator[None]:
    """Hold the linear-algebra libraries to one thread.

    The matrices of a loop are small: a second thread gains nothing on them, and while anything else
    runs on the machine the threads wait for each other, many times longer than the work takes.
    """
    from threadpoolctl import threadpool_limits

    with threadpool_limits(limits=1):
        yield
