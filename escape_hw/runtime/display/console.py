"""The console of messages and progress."""

from __future__ import annotations

from rich.console import Console


class DisplayConsole(Console):
    """A console on standard error that raises ``BrokenPipeError`` when nobody reads it.

    Rich would end the program and redirect its standard output.
    """

    def __init__(self) -> None:
        super().__init__(stderr=True)

    def on_broken_pipe(self) -> None:
        """Raise the present ``BrokenPipeError``."""
        raise
