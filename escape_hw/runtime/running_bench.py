"""A bench that drives procedures to their end."""

from __future__ import annotations

from typing import TypeVar

from escape_hw.api.procedure import Observer, Procedure, Stop
from escape_hw.api.procedure import run as run_procedure
from escape_hw.bench import Bench

T = TypeVar("T")


class RunningBench(Bench):
    """A bench whose procedures are run, with a bar of progress when asked for."""

    def run(
        self,
        procedure: Procedure[T],
        *,
        observers: tuple[Observer, ...] = (),
        abort: Stop | None = None,
        progress: bool = False,
    ) -> T:
        """Drive a procedure to its end and return its result.

        Parameters
        ----------
        procedure
            A generator made from this bench, such as one's own.
        observers
            Called with every progress report.
        abort
            Set it from any thread to stop the procedure.
        progress
            Show a bar with the time left on standard error.

        Raises
        ------
        Aborted
            Stopped by ``abort`` or Ctrl-C.
        """
        if not progress:
            return run_procedure(procedure, observers=observers, abort=abort)
        from rich.console import Console

        from escape_hw.runtime.progress import ProgressView

        with ProgressView(Console(stderr=True)) as view:
            return run_procedure(procedure, observers=(*observers, view), abort=abort)
