"""Thin binding of ALPAO's libasdk: prototypes, outcomes turned into errors, nothing else.

Prototypes after the public headers asdkDM.h, asdkType.h, asdkErrNo.h: ``Scalar`` is double, ``UInt``
uint32, ``COMPL_STAT`` an int (0 success, -1 failure), ``asdkDM`` opaque.
"""

from __future__ import annotations

import ctypes
from ctypes import POINTER, c_char_p, c_double, c_int, c_size_t, c_uint32, c_void_p
from typing import Any

from escape_drivers.alpao_errors import LOST, explain
from escape_drivers.vendor_library import VendorLibrary, is_stand_in
from escape_hw.errors import DeviceError, DeviceLost

SDK = VendorLibrary(
    "ALPAO SDK", ("libasdk.so",), "ESCAPE_ALPAO_LIBRARY", "install the SDK that came with the mirror"
)
_PROTOTYPES: dict[str, tuple[Any, list[Any]]] = {
    "asdkInit": (c_void_p, [c_char_p]),
    "asdkRelease": (c_int, [c_void_p]),
    "asdkSend": (c_int, [c_void_p, c_void_p]),
    "asdkSendPattern": (c_int, [c_void_p, c_void_p, c_uint32, c_uint32]),
    "asdkStop": (c_int, [c_void_p]),
    "asdkReset": (c_int, [c_void_p]),
    "asdkGet": (c_int, [c_void_p, c_char_p, POINTER(c_double)]),
    "asdkSet": (c_int, [c_void_p, c_char_p, c_double]),
    "asdkGetLastError": (c_int, [POINTER(c_uint32), c_char_p, c_size_t]),
}
#: Entries that are taken off the error stack before giving up: where reading leaves them there, no
#: number of readings empties it.
_STACK = 64
_TEXT_BYTES = 1024


class AlpaoLibrary:
    """The SDK, loaded; every method but :meth:`init` works on an ``asdkDM`` handle.

    Parameters
    ----------
    device
        Name used in error messages.
    path
        Of the library; empty: the environment, then the default name.

    Raises
    ------
    DeviceError
        The library is missing or is another one.
    """

    def __init__(self, device: str, path: str = "") -> None:
        self.device = device
        self.c = SDK.bind(device, path, _PROTOTYPES)
        self.stand_in = is_stand_in(self.c)

    def init(self, serial: str) -> c_void_p:
        """Connect to the mirror of a serial number.

        A handle alone does not mean success: without a configuration the SDK may give one all the
        same. So the error stack decides.

        Raises
        ------
        DeviceError
            It failed. What it gave is released, and never reset: the SDK may crash on that.
        """
        stale = self._drain()
        handle = self.c.asdkInit(serial.encode())
        error = self.last_error()
        if handle and (error is None or error == stale):
            return c_void_p(handle)
        if handle:
            self.c.asdkRelease(handle)
        if error is None:
            raise DeviceError(self.device, f"the SDK did not open mirror {serial!r} and does not say why")
        raise DeviceError(self.device, f"the SDK did not open mirror {serial!r}: {explain(*error)}")

    def last_error(self) -> tuple[int, str] | None:
        """Number and text of the newest error, or ``None`` when there is none."""
        number, text = c_uint32(), ctypes.create_string_buffer(_TEXT_BYTES)
        if self.c.asdkGetLastError(ctypes.byref(number), text, _TEXT_BYTES) != 0 or number.value == 0:
            return None
        return number.value, text.value.decode(errors="replace").strip()

    def _drain(self) -> tuple[int, str] | None:
        """Empty the error stack, which outlives mirrors; what cannot be taken off is returned."""
        error = None
        for _ in range(_STACK):
            error = self.last_error()
            if error is None:
                return None
        return error

    def failure(self, call: str) -> DeviceError:
        """The error to raise after a call that failed."""
        error = self.last_error()
        if error is None:
            return DeviceError(self.device, f"{call} failed, and the SDK does not say why")
        kind = DeviceLost if error[0] in LOST else DeviceError
        return kind(self.device, f"{call} failed: {explain(*error)}")

    def call(self, name: str, handle: c_void_p, *arguments: Any) -> None:
        """Call a function whose outcome is a ``COMPL_STAT``.

        Raises
        ------
        DeviceLost, DeviceError
            It failed.
        """
        if getattr(self.c, name)(handle, *arguments) != 0:
            raise self.failure(name)

    def get(self, handle: c_void_p, name: str) -> float:
        """Read a parameter.

        Raises
        ------
        DeviceLost, DeviceError
            It failed.
        """
        value = c_double()
        if self.c.asdkGet(handle, name.encode(), ctypes.byref(value)) != 0:
            raise self.failure(f"asdkGet({name})")
        return value.value

    def set(self, handle: c_void_p, name: str, value: float) -> None:
        """Write a parameter.

        Raises
        ------
        DeviceLost, DeviceError
            It failed.
        """
        if self.c.asdkSet(handle, name.encode(), value) != 0:
            raise self.failure(f"asdkSet({name}, {value:g})")


def version_text(number: float) -> str:
    """``VersionInfo`` as people write it: 3040500612 is 3.04.05.0612."""
    whole = round(number)
    major, rest = divmod(whole, 10**9)
    minor, rest = divmod(rest, 10**7)
    patch, build = divmod(rest, 10**5)
    return f"{major}.{minor:02d}.{patch:02d}.{build:04d}"
