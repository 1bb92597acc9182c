"""Procedures are generators; one runner drives them for the command line, the GUI and scripts."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from escape_hw.errors import Aborted

log = logging.getLogger(__name__)

T = TypeVar("T")


@dataclass(frozen=True, slots=True, eq=False)
class Progress:
    """A procedure's word on how far it is.

    Parameters
    ----------
    stage
        What is being done, in words an operator uses.
    done, total
        Steps done and to do in this stage, in ``unit``.
    elapsed_s
        Wall-clock seconds since the stage began.
    metrics
        Scalars worth watching.
    arrays
        Small arrays worth plotting (decimated).
    """

    stage: str
    done: int
    total: int
    unit: str = "frame"
    elapsed_s: float = 0.0
    metrics: Mapping[str, float] = field(default_factory=dict)
    arrays: Mapping[str, NDArray[np.float32]] = field(default_factory=dict)

    @property
    def fraction(self) -> float:
        """Share done, 0 to 1."""
        return min(1.0, self.done / self.total) if self.total else 1.0

    @property
    def remaining_s(self) -> float:
        """Estimated wall-clock seconds left in this stage."""
        return self.elapsed_s * (self.total - self.done) / self.done if self.done else float("nan")


Procedure = Generator[Progress, None, T]
Observer = Callable[[Progress], None]


class Reporter:
    """Makes a stage's :class:`Progress`, at most 20 times a second.

    ``due`` is cheap enough to be asked for every frame.
    """

    PERIOD_S = 0.05

    def __init__(self, stage: str, total: int, unit: str = "frame") -> None:
        self.stage, self.total, self.unit = stage, total, unit
        self._start = time.monotonic()
        self._next = self._start

    def due(self) -> bool:
        """True when the next progress may be yielded."""
        return time.monotonic() >= self._next

    def __call__(self, done: int, **metrics: float) -> Progress:
        """The progress to yield now."""
        now = time.monotonic()
        self._next = now + self.PERIOD_S
        return Progress(self.stage, done, self.total, self.unit, now - self._start, metrics)


def run(
    procedure: Procedure[T],
    *,
    observers: tuple[Observer, ...] = (),
    abort: threading.Event | None = None,
) -> T:
    """Drive a procedure to its end and return its result.

    The procedure is responsible for leaving the mirror flat (``finally``); the runner makes sure
    that it gets the chance: an abort or Ctrl-C is thrown into it as :class:`Aborted`.

    Parameters
    ----------
    procedure
        The generator to drive.
    observers
        Called with every :class:`Progress`; one that raises is dropped and logged.
    abort
        Set it from any thread to stop the procedure at its next step.

    Raises
    ------
    Aborted
        Stopped by ``abort`` or Ctrl-C; carries the partial result when the procedure made one.
    """
    watching = list(observers)
    stop = False
    while True:
        try:
            progress = procedure.throw(Aborted()) if stop else next(procedure)
        except StopIteration as done:
            result: T = done.value
            if stop:
                raise Aborted(partial=result) from None
            return result
        except KeyboardInterrupt:
            # Raised inside the generator: its finally clauses have already run.
            raise Aborted("interrupted by Ctrl-C") from None
        try:
            for observer in tuple(watching):
                try:
                    observer(progress)
                except Exception:
                    log.exception("observer %r failed and is dropped", observer)
                    watching.remove(observer)
        except KeyboardInterrupt:
            stop = True
        stop = stop or (abort is not None and abort.is_set())
