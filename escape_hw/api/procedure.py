"""Procedures (generators of progress) and the function that runs them."""

from __future__ import annotations

import logging
import signal
import threading
import time
from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from types import FrameType
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.concurrency import SignalSafeFlag
from escape_hw.api.representation import short_repr
from escape_hw.deprecation import renamed_members
from escape_hw.errors import Aborted

log = logging.getLogger(__name__)

T = TypeVar("T")

#: Time for clean-up after an abort, wall-clock seconds.
ABORT_GRACE_S = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Progress:
    """Progress of a procedure.

    Parameters
    ----------
    stage
        Name of the stage, for the operator.
    done, total
        Completed and total number of steps of this stage, in ``unit``.
    elapsed_s
        Wall-clock seconds since the start of the stage.
    metrics
        Scalars to display.
    arrays
        Arrays to plot: ``matrix``, ``matrix_sigma``, ``valid``, ``registration``, ``registration_sigma``,
        ``step_norm``, ``registration_track``, ``gains``, ``gains_sigma``, ``gains_smooth``,
        ``gains_rounds``, ``residual``. In a matrix, modes not measured yet are NaN.
    """

    stage: str
    done: int
    total: int
    unit: str = "frame"
    elapsed_s: float = 0.0
    metrics: Mapping[str, float] = field(default_factory=dict)
    arrays: Mapping[str, NDArray[np.float32]] = field(default_factory=dict)
    __repr__ = short_repr

    @property
    def fraction(self) -> float:
        """Completed fraction, 0 to 1."""
        return min(1.0, self.done / self.total) if self.total else 1.0

    @property
    def remaining_s(self) -> float:
        """Estimated wall-clock seconds left in this stage; NaN before the first step."""
        if not self.done:
            return float("nan")
        return self.elapsed_s * max(0, self.total - self.done) / self.done

    def to_dict(self) -> dict[str, str | int]:
        """Stage and steps in plain values."""
        return {"stage": self.stage, "done": self.done, "total": self.total, "unit": self.unit}


#: Request to stop.
StopSignal = SignalSafeFlag | threading.Event
Procedure = Generator[Progress, None, T]
Observer = Callable[[Progress], None]


@renamed_members(due="is_due")
class Reporter:
    """Creates the :class:`Progress` of a stage, at most 20 times a second.

    ``step`` and ``is_due`` are fast enough to be called for every frame.
    """

    PERIOD_S = 0.05

    def __init__(self, stage: str, total: int, unit: str = "frame") -> None:
        self.stage, self.total, self.unit = stage, total, unit
        self._start = time.monotonic()
        self._next = self._start
        self._done = 0

    def step(self, **metrics: float) -> Progress | None:
        """Count one step; returns a progress to yield if one is due, else ``None``."""
        self._done += 1
        return self(self._done, **metrics) if self.is_due() else None

    def is_due(self) -> bool:
        """Whether the next progress is due."""
        return time.monotonic() >= self._next

    def now(self, arrays: Mapping[str, NDArray[np.float32]], **metrics: float) -> Progress:
        """The progress after the steps counted so far, with arrays."""
        return self(self._done, arrays, **metrics)

    def __call__(
        self, done: int, arrays: Mapping[str, NDArray[np.float32]] | None = None, /, **metrics: float
    ) -> Progress:
        """The progress to yield now."""
        now = time.monotonic()
        self._next = now + self.PERIOD_S
        elapsed = now - self._start
        # Some stages end later than expected, such as a search from several starts.
        return Progress(self.stage, done, max(self.total, done), self.unit, elapsed, metrics, arrays or {})


def run(
    procedure: Procedure[T],
    *,
    observers: tuple[Observer, ...] = (),
    abort: StopSignal | None = None,
) -> T:
    """Run a procedure to its end and return its result.

    The procedure flattens the mirror in its ``finally`` clauses. To stop it, :class:`Aborted` is thrown
    into it **once**, between two steps, so that no transfer to a device is interrupted. It may then return
    a partial result, raise, or yield further progress during its clean-up; after :data:`ABORT_GRACE_S` it
    is closed, which runs its ``finally`` clauses.

    In the main thread the first Ctrl-C stops the procedure in the same way, unless another handler is
    installed. A second Ctrl-C interrupts at once, also within a step.

    Parameters
    ----------
    procedure
        The generator.
    observers
        Called with every :class:`Progress`. An observer that raises is logged and removed.
    abort
        Set it from any thread to stop the procedure at its next step.

    Raises
    ------
    Aborted
        Stopped by ``abort`` or Ctrl-C; has the partial result if the procedure returned one.
    """
    interrupted = SignalSafeFlag()
    try:
        with _set_on_ctrl_c(interrupted):
            return _advance_until_done(procedure, list(observers), abort or SignalSafeFlag(), interrupted)
    except KeyboardInterrupt as interruption:
        raise Aborted(f"interrupted by {str(interruption) or 'Ctrl-C'}") from None
    finally:
        _close(procedure)


def _advance_until_done(
    procedure: Procedure[T],
    observers_left: list[Observer],
    abort: StopSignal,
    interrupted: SignalSafeFlag,
) -> T:
    deadline, last = None, None
    while True:
        throw = deadline is None and (abort.is_set() or interrupted.is_set())
        try:
            if throw:
                deadline = time.monotonic() + ABORT_GRACE_S
                progress = procedure.throw(_aborted_error(interrupted, last))
            else:
                progress = next(procedure)
        except StopIteration as done:
            result: T = done.value
            if deadline is not None:
                raise _aborted_error(interrupted, last, partial=result) from None
            return result
        if deadline is not None and time.monotonic() > deadline:
            log.error("the procedure did not end within %g s after the abort and is closed", ABORT_GRACE_S)
            raise _aborted_error(interrupted, last)
        if deadline is None:
            last = progress
        try:
            _notify_observers(observers_left, progress)
        except KeyboardInterrupt:
            interrupted.set()


def _notify_observers(observers_left: list[Observer], progress: Progress) -> None:
    for observer in tuple(observers_left):
        try:
            observer(progress)
        except Exception:
            log.exception("observer %r failed and is removed", observer)
            observers_left.remove(observer)


def _aborted_error(interrupted: SignalSafeFlag, last: Progress | None, partial: object = None) -> Aborted:
    message = "interrupted by Ctrl-C" if interrupted.is_set() else "aborted by the operator"
    return Aborted(message, partial, None if last is None else last.to_dict())


def _close(procedure: Procedure[T]) -> None:
    """Run the remaining clean-up of a procedure; does nothing if it has ended."""
    try:
        procedure.close()
    except RuntimeError:
        log.exception("the procedure did not close; check whether the mirror is flat")


@contextmanager
def _set_on_ctrl_c(flag: SignalSafeFlag) -> Iterator[None]:
    """Let the first Ctrl-C set ``flag`` and the next one interrupt as usual.

    Does nothing outside the main thread or if the application has its own handler.
    """
    in_main_thread = threading.current_thread() is threading.main_thread()
    if not in_main_thread or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        return

    def on_first_interrupt(signum: int, frame: FrameType | None) -> None:
        flag.set()
        signal.signal(signal.SIGINT, signal.default_int_handler)

    signal.signal(signal.SIGINT, on_first_interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
