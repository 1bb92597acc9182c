"""Devices that are there: what a search finds, and how packages take part in it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Found:
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
Discoverer = Callable[[Sequence[str]], list[Found]]
