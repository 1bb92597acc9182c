"""An open system, as scripts and notebooks use it."""

from __future__ import annotations

import os
import threading
from collections.abc import Sequence
from typing import TypeVar

from escape_hw.api.procedure import Observer, Procedure
from escape_hw.api.procedure import run as run_procedure
from escape_hw.bench import Bench
from escape_hw.config.load import load_system

T = TypeVar("T")


class System(Bench):
    """A bench with everything that can be done on it."""

    def run(
        self,
        procedure: Procedure[T],
        *,
        observers: tuple[Observer, ...] = (),
        abort: threading.Event | None = None,
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

        Raises
        ------
        Aborted
            Stopped by ``abort`` or Ctrl-C.
        """
        return run_procedure(procedure, observers=observers, abort=abort)


def open_system(
    system: str | os.PathLike[str],
    *,
    set: Sequence[str] = (),
    seed: int | None = None,
    mode: str | None = None,
) -> System:
    """Load a configuration, build its devices and open them.

    Use it in a ``with`` statement, or call ``close()``: that flattens the mirror.

    Parameters
    ----------
    system
        Name of a bundled system, or path of a TOML file.
    set
        Overrides, ``section.key=value`` each.
    seed
        Seed of every random stream; absent: as configured.
    mode
        ``'sim'`` or ``'hardware'``; absent: as configured.

    Raises
    ------
    ConfigError
        The configuration is wrong or a driver is not installed; nothing was opened.
    DeviceError
        A device cannot be reached; nothing is left open.
    """
    return System.from_config(load_system(system, overrides=set, seed=seed, mode=mode)).open()
