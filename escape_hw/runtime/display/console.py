"""The console of messages and progress."""

from __future__ import annotations

import contextlib

from rich.console import Console

from escape_hw.runtime.display.descriptors import redirect_to_null


class DisplayConsole(Console):
    """A console on standard error that raises ``BrokenPipeError`` when its reader has gone.

    Rich would end the program and redirect its standard output.
    """

    def __init__(self) -> None:
        super().__init__(stderr=True)

    def on_broken_pipe(self) -> None:
        """Send the rest of standard error to the null device and raise the present ``BrokenPipeError``."""
        with contextlib.suppress(OSError, ValueError):  # a stream without a descriptor, as in a notebook
            redirect_to_null(self.file.fileno())
        raise
