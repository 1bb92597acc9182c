"""Interfaces for finding devices and vendor libraries (``escape discover``, ``escape doctor``)."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass


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


def device_section_toml(section: str, driver: str, serial: str) -> str:
    """Lines of a real device's section in a system file."""
    return f'[devices.{section}]\nmode = "hardware"\ndriver = "{driver}"\nserial = "{serial}"'


@dataclass(frozen=True, slots=True)
class VendorLibrary:
    """Where a vendor's library may be; an entry point of ``escape.libraries``, named after its driver.

    Parameters
    ----------
    title
        Display name, such as "ALPAO SDK".
    default
        File names for the system's loader, in order of preference.
    variable
        Environment variable with the path of the library.
    source
        Where to obtain the library.
    """

    title: str
    default: tuple[str, ...]
    variable: str
    source: str

    def load(self, path: str = "") -> ctypes.CDLL:
        """Load the library from ``path``, the path in the environment, or a default name.

        Raises
        ------
        OSError
            It cannot be loaded; the message has the reason for every file tried.
        """
        chosen = path or os.environ.get(self.variable, "")
        failures = []
        for name in (chosen,) if chosen else self.default:
            try:
                return ctypes.CDLL(name)
            except OSError as error:
                failures.append(str(error))
        raise OSError("; ".join(failures))
