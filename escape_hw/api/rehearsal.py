"""Rehearsals: real drivers on a simulated bench, through stand-ins of their vendors' libraries."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Protocol


class Rehearsal(Protocol):
    """A simulated bench that real drivers reach, each through its own library."""

    @property
    def environment(self) -> Mapping[str, str]:
        """What a process needs in its environment for its drivers to find the bench."""

    def start(self) -> str:
        """Begin to serve; returns where.

        Raises
        ------
        EscapeError
            This machine cannot: it has no C compiler, for instance.
        """

    def stop(self) -> None:
        """Hang up on everybody; may be repeated."""


#: What an entry point of the group ``escape.rehearsals`` is: takes the configuration of the system
#: (:class:`~escape_hw.config.models.SystemConfig`).
RehearsalFactory = Callable[[Any], Rehearsal]
