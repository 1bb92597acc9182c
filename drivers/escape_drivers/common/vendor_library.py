"""Finds and loads a vendor's shared library, when a device is opened and not before."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from escape_hw.errors import DeviceError

#: Symbol that only the stand-ins of this project export.
_STAND_IN = "escape_stand_in"


@dataclass(frozen=True, slots=True)
class VendorLibrary:
    """Where a vendor's library may be.

    Parameters
    ----------
    what
        Name for people, such as "ALPAO SDK".
    default
        File names for the system's loader, the preferred one first.
    variable
        Environment variable that may hold a path.
    source
        Where the library comes from, for the message when it is missing.
    """

    title: str
    default: tuple[str, ...]
    variable: str
    source: str

    def load(self, device: str, path: str = "") -> ctypes.CDLL:
        """Load the library; its calls release the interpreter's lock.

        Parameters
        ----------
        device
            Device that needs it, for messages.
        path
            File or name; empty: the environment variable decides, and then the default name.

        Raises
        ------
        DeviceError
            The library is missing or cannot be loaded.
        """
        chosen = path or os.environ.get(self.variable, "")
        failures = []
        for name in (chosen,) if chosen else self.default:
            try:
                return ctypes.CDLL(name)
            except OSError as error:
                failures.append(str(error))
        raise DeviceError(
            device,
            f"the library of the {self.title} cannot be loaded ({'; '.join(failures)}); {self.source}, then "
            f"name its file in the option 'library' of the device or in {self.variable}",
        )

    def bind(
        self, device: str, path: str, prototypes: Mapping[str, tuple[Any, Sequence[Any]]]
    ) -> ctypes.CDLL:
        """Load the library and declare what the driver calls.

        Parameters
        ----------
        device, path
            As for :meth:`load`.
        prototypes
            Type of the result and types of the arguments by the function's name.

        Raises
        ------
        DeviceError
            The library is missing or is another one.
        """
        library = self.load(device, path)
        require_symbols(device, library, list(prototypes))
        for name, (result, arguments) in prototypes.items():
            function = getattr(library, name)
            function.restype, function.argtypes = result, arguments
        return library


def require_symbols(device: str, library: ctypes.CDLL, names: Sequence[str]) -> None:
    """Check that a library exports what the driver calls.

    Raises
    ------
    DeviceError
        It is another library, or its version is too old.
    """
    loaded_as = vars(library).get("_name", "the library")
    missing = [name for name in names if not hasattr(library, name)]
    if missing:
        raise DeviceError(
            device, f"{loaded_as} does not export {', '.join(missing)}; is it the right library?"
        )


def is_stand_in(library: ctypes.CDLL) -> bool:
    """True for a stand-in of this project, which drives no hardware."""
    return hasattr(library, _STAND_IN)
