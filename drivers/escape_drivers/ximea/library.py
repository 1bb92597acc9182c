"""Binding of XIMEA's libm3api: prototypes, image structure, error codes and their explanations.

Layout and prototypes follow the public xiApi.h of version 4.27 (x86-64).
"""

from __future__ import annotations

import ctypes
from ctypes import POINTER, c_char_p, c_double, c_float, c_int, c_uint32, c_void_p
from typing import Any

from escape_drivers.common.vendor_library import LoadedLibrary, Prototypes
from escape_hw.api.discovery import VendorLibrary
from escape_hw.errors import DeviceError

_RECONNECT_HINT = "check cable and power, then open the camera again"
_IN_USE_HINT = (
    "another process holds it: close that one; after a crash unplug the camera and plug it in again"
)

#: Code: what happened and, where one is known, the way out.
ERRORS: dict[int, tuple[str, str]] = {
    1: ("invalid handle", _RECONNECT_HINT),
    9: ("no image", ""),
    10: ("time-out", ""),
    11: ("bad arguments", "the value is outside what the camera takes with its other settings"),
    12: ("not supported", ""),
    13: ("buffers cannot be attached", "raise usbcore.usbfs_memory_mb, see docs/devices/ximea.md"),
    15: ("not enough memory", "raise usbcore.usbfs_memory_mb, see docs/devices/ximea.md"),
    41: ("acquisition runs already", ""),
    45: ("acquisition is stopped", ""),
    49: ("not ready", ""),
    55: ("the camera was reset", "its settings are lost; open it again"),
    56: ("no such camera", "check serial number, cable, permissions (udev) and usbfs memory"),
    57: ("the camera is locked", _IN_USE_HINT),
    58: ("the buffer is too small", ""),
    100: ("unknown parameter", "this version of the library may be too old"),
    101: ("wrong value", ""),
    103: ("wrong type", ""),
    104: ("wrong size", ""),
    105: ("the input buffer is too small", ""),
    106: ("the camera does not have this parameter", "take the option out of its configuration"),
    108: ("the data format is not supported", ""),
    109: ("read only", ""),
    111: ("not enough bandwidth", "lower the frame rate or the region, or set bandwidth_mbit"),
    114: ("cannot be set now", ""),
    119: ("not available in this context", ""),
}
NO_IMAGE, TIMEOUT, STOPPED = 9, 10, 45


def describe_error(code: int) -> str:
    """One line: code, meaning, and the way out."""
    meaning, remedy = ERRORS.get(code, ("unknown error", "see the list of codes in the vendor's xiApi.h"))
    return f"error {code}, {meaning}{'; ' if remedy else ''}{remedy}"


XIAPI = VendorLibrary(
    "XIMEA API",
    ("libm3api.so.2", "libm3api.so"),
    "ESCAPE_XIMEA_LIBRARY",
    "install XIMEA's Linux software package",
)
#: Selector of ``xiOpenDeviceBy``: by serial number.
_BY_SERIAL = 1
_TEXT_BYTES = 256


class XiImage(ctypes.Structure):
    """``XI_IMG`` up to its version 16; the library fills what fits into ``size``."""

    _fields_ = (
        ("size", c_uint32),
        ("bp", c_void_p),
        ("bp_size", c_uint32),
        ("frm", c_int),
        ("width", c_uint32),
        ("height", c_uint32),
        ("nframe", c_uint32),
        ("tsSec", c_uint32),
        ("tsUSec", c_uint32),
        ("GPI_level", c_uint32),
        ("black_level", c_uint32),
        ("padding_x", c_uint32),
        ("AbsoluteOffsetX", c_uint32),
        ("AbsoluteOffsetY", c_uint32),
        ("transport_frm", c_uint32),
        ("img_desc", c_uint32 * 28),
        ("DownsamplingX", c_uint32),
        ("DownsamplingY", c_uint32),
        ("flags", c_uint32),
        ("exposure_time_us", c_uint32),
        ("gain_db", c_float),
        ("acq_nframe", c_uint32),
        ("image_user_data", c_uint32),
        ("exposure_sub_times_us", c_uint32 * 5),
        ("data_saturation", c_double),
        ("wb", c_float * 3),
        ("black_levels", c_uint32 * 2),
        ("ranges", c_uint32 * 2),
        ("gain_ratio", c_float),
        ("fDownsampling", c_float * 2),
        ("color_filter_array", c_int),
    )


_ARGUMENTS: dict[str, list[Any]] = {
    "xiOpenDeviceBy": [c_int, c_char_p, POINTER(c_void_p)],
    "xiCloseDevice": [c_void_p],
    "xiStartAcquisition": [c_void_p],
    "xiStopAcquisition": [c_void_p],
    "xiGetImage": [c_void_p, c_uint32, c_void_p],
    "xiSetParamInt": [c_void_p, c_char_p, c_int],
    "xiSetParamFloat": [c_void_p, c_char_p, c_float],
    "xiGetParamInt": [c_void_p, c_char_p, POINTER(c_int)],
    "xiGetParamFloat": [c_void_p, c_char_p, POINTER(c_float)],
    "xiGetParamString": [c_void_p, c_char_p, c_void_p, c_uint32],
}


_PROTOTYPES: Prototypes = {name: (c_int, arguments) for name, arguments in _ARGUMENTS.items()}


class XimeaLibrary(LoadedLibrary):
    """The library, loaded, with one camera."""

    VENDOR, PROTOTYPES, LOST_CODES = XIAPI, _PROTOTYPES, frozenset({1, 55, 56})

    def __init__(self, device: str, path: str = "") -> None:
        super().__init__(device, path)
        self.handle: c_void_p | None = None

    def open(self, serial: str) -> None:
        """Connect to the camera of a serial number."""
        handle = c_void_p()
        code = self.c.xiOpenDeviceBy(_BY_SERIAL, serial.encode(), ctypes.byref(handle))
        if code != 0:
            raise DeviceError(self.device, f"camera {serial!r} was not opened: {describe_error(code)}")
        self.handle = handle

    def close(self) -> None:
        """Disconnect; the handle is given up also after an error."""
        handle, self.handle = self.handle, None
        if handle is not None:
            self._check_code("xiCloseDevice", self.c.xiCloseDevice(handle))

    def start(self) -> None:
        """Start acquisition."""
        self._check_code("xiStartAcquisition", self.c.xiStartAcquisition(self.handle))

    def stop(self) -> None:
        """Stop acquisition; no error if it has stopped already, as after a reset."""
        code = self.c.xiStopAcquisition(self.handle)
        self._check_code("xiStopAcquisition", 0 if code == STOPPED else code)

    def set(self, name: str, value: int | float) -> None:
        """Set a parameter, of the type that the value has."""
        function = self.c.xiSetParamFloat if isinstance(value, float) else self.c.xiSetParamInt
        self._check_code(f"{name} = {value:g}", function(self.handle, name.encode(), value))

    def get_int(self, name: str) -> int:
        """Read an integer parameter."""
        value = c_int()
        self._check_code(name, self.c.xiGetParamInt(self.handle, name.encode(), ctypes.byref(value)))
        return value.value

    def get_float(self, name: str) -> float:
        """Read a floating-point parameter."""
        value = c_float()
        self._check_code(name, self.c.xiGetParamFloat(self.handle, name.encode(), ctypes.byref(value)))
        return value.value

    def get_text(self, name: str) -> str:
        """Read a text parameter."""
        buffer = ctypes.create_string_buffer(_TEXT_BYTES)
        self._check_code(name, self.c.xiGetParamString(self.handle, name.encode(), buffer, _TEXT_BYTES))
        return buffer.value.decode(errors="replace")

    def error_for(self, what: str, code: int) -> DeviceError:
        """The error to raise for a code."""
        return self._error(code, f"{what}: {describe_error(code)}")

    def _check_code(self, what: str, code: int) -> None:
        if code != 0:
            raise self.error_for(what, code)
