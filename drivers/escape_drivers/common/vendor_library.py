"""A vendor's shared library, loaded when a device is opened and not before."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

from escape_hw.api.discovery import VendorLibrary
from escape_hw.errors import DeviceError, DeviceLost

#: Symbol that only the stand-ins of this project export; they drive no hardware.
_STAND_IN = "escape_stand_in"
#: Type of the result and types of the arguments by the name of a function.
Prototypes = Mapping[str, tuple[Any, Sequence[Any]]]


class LoadedLibrary:
    """A vendor's library, loaded, with the functions that a driver calls.

    Calls release the interpreter lock.

    Every method of a subclass raises ``DeviceLost`` after an error in :attr:`LOST_CODES` and ``DeviceError``
    after any other, with the library's explanation.

    Parameters
    ----------
    device
        Name used in error messages.
    path
        File or name of the library; empty: the environment variable decides, then the default names.

    Attributes
    ----------
    c
        The functions.
    stand_in
        True for a stand-in of this project.

    Raises
    ------
    DeviceError
        The library is missing, is another one, or its version is too old.
    """

    VENDOR: ClassVar[VendorLibrary]
    PROTOTYPES: ClassVar[Prototypes]
    #: Errors after which the device must be opened again.
    LOST_CODES: ClassVar[frozenset[int]] = frozenset()

    def __init__(self, device: str, path: str) -> None:
        self.device = device
        vendor = self.VENDOR
        try:
            self.c = vendor.load(path)
        except OSError as error:
            raise DeviceError(
                device,
                f"{vendor.title} cannot be loaded ({error}); {vendor.source}, then "
                f"name its file in the option 'library' of the device or in {vendor.variable}",
            ) from error
        missing = [name for name in self.PROTOTYPES if not hasattr(self.c, name)]
        if missing:
            loaded_as = vars(self.c).get("_name", "the library")
            raise DeviceError(
                device, f"{loaded_as} does not export {', '.join(missing)}; is it the right library?"
            )
        for name, (result, arguments) in self.PROTOTYPES.items():
            function = getattr(self.c, name)
            function.restype, function.argtypes = result, arguments
        self.stand_in = hasattr(self.c, _STAND_IN)

    def _error(self, code: int, message: str) -> DeviceError:
        kind = DeviceLost if code in self.LOST_CODES else DeviceError
        return kind(self.device, message)
