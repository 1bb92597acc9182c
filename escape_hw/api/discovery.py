"""What packages tell about devices and libraries that are there, for ``escape discover`` and ``doctor``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True, slots=True)
class DiscoveredDevice:
    """A device that can be reached.

    Parameters
    ----------
    kind
        What it is: ``deformable mirror``, ``camera``, ``modulator``, ``adaptive secondary``.
    model, serial
        As it tells them; may be empty.
    where
        File, address or folder.
    driver
        Which driver drives it.
    in_use_by
        Who has it open now, as far as can be seen.
    toml
        Lines to paste into the system's file.
    """

    kind: str
    model: str
    serial: str
    where: str
    driver: str
    in_use_by: tuple[str, ...]
    toml: str


#: What an entry point of the group ``escape.discover`` is: looks at hosts (``name`` or ``name:port``).
Discoverer = Callable[[Sequence[str]], list[DiscoveredDevice]]


class NativeLibrary(Protocol):
    """What an entry point of the group ``escape.libraries`` is, by the name of the driver that loads it."""

    @property
    def title(self) -> str:
        """Name for people."""

    @property
    def default(self) -> tuple[str, ...]:
        """File names that the system's loader is asked for, the preferred one first."""

    @property
    def variable(self) -> str:
        """Environment variable that may hold a path."""

    @property
    def source(self) -> str:
        """How to come by it."""
