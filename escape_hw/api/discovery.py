"""Interfaces for finding devices and vendor libraries (``escape discover``, ``escape doctor``)."""

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
        ``deformable mirror``, ``camera``, ``modulator`` or ``adaptive secondary``.
    model, serial
        As reported by the device; may be empty.
    where
        File, address or folder.
    driver
        Name of its driver.
    in_use_by
        Processes that have it open, as far as known.
    toml
        Lines for the system file.
    """

    kind: str
    model: str
    serial: str
    where: str
    driver: str
    in_use_by: tuple[str, ...]
    toml: str


#: Type of an entry point of the group ``escape.discover``: searches hosts (``name`` or ``name:port``).
Discoverer = Callable[[Sequence[str]], list[DiscoveredDevice]]


class NativeLibrary(Protocol):
    """Type of an entry point of the group ``escape.libraries``, named after the driver that loads it."""

    @property
    def title(self) -> str:
        """Display name."""

    @property
    def default(self) -> tuple[str, ...]:
        """File names for the system's loader, in order of preference."""

    @property
    def variable(self) -> str:
        """Environment variable with the path of the library."""

    @property
    def source(self) -> str:
        """Where to obtain the library."""
