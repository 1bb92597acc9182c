"""Thin binding of XIMEA's libm3api: prototypes, the image structure, codes turned into errors.

Layout and prototypes after the public xiApi.h of version 4.27 (x86-64).
"""

from __future__ import annotations

import ctypes
from ctypes import POINTER, c_char_p, c_double, c_float, c_int, c_uint32, c_void_p
from typing import Any

from escape_drivers.vendor_library import VendorLibrary, is_stand_in
from escape_drivers.ximea_errors import LOST, STOPPED, explain
from escape_hw.errors import DeviceError, DeviceLost

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


_PROTOTYPES: dict[str, list[Any]] = {
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


class XimeaLibrary:
    """The library, loaded, with one camera.

    Parameters
    ----------
    device
        Name used in error messages.
    path
        Of the library; empty: the environment, then the default names.

    Raises
    ------
    DeviceError
        The library is missing or is another one.
    """

    def __init__(self, device: str, path: str = "") -> None:
        self.device = device
        prototypes = {name: (c_int, arguments) for name, arguments in _PROTOTYPES.items()}
        self.c = XIAPI.bind(device, path, prototypes)
        self.stand_in = is_stand_in(self.c)
        self.handle: c_void_p | None = None

    def open(self, serial: str) -> None:
        """Connect to the camera of a serial number.

        Raises
        ------
        DeviceError
            There is none, or another process has it.
        """
        handle = c_void_p()
        code = self.c.xiOpenDeviceBy(_BY_SERIAL, serial.encode(), ctypes.byref(handle))
        if code != 0:
            raise DeviceError(self.device, f"camera {serial!r} was not opened: {explain(code)}")
        self.handle = handle

    def close(self) -> None:
        """Disconnect.

        Raises
        ------
        DeviceLost, DeviceError
            It failed; the handle is given up all the same.
        """
        handle, self.handle = self.handle, None
        self._done("xiCloseDevice", self.c.xiCloseDevice(handle))

    def start(self) -> None:
        """Start acquisition.

        Raises
        ------
        DeviceLost, DeviceError
            It failed.
        """
        self._done("xiStartAcquisition", self.c.xiStartAcquisition(self.handle))

    def stop(self) -> None:
        """Stop acquisition; that it has stopped already, as after a reset, will do.

        Raises
        ------
        DeviceLost, DeviceError
            It failed.
        """
        code = self.c.xiStopAcquisition(self.handle)
        self._done("xiStopAcquisition", 0 if code == STOPPED else code)

    def set(self, name: str, value: int | float) -> None:
        """Set a parameter, of the type that the value has.

        Raises
        ------
        DeviceLost, DeviceError
            It was refused.
        """
        function = self.c.xiSetParamFloat if isinstance(value, float) else self.c.xiSetParamInt
        self._done(f"{name} = {value:g}", function(self.handle, name.encode(), value))

    def whole(self, name: str) -> int:
        """Read an integer parameter.

        Raises
        ------
        DeviceLost, DeviceError
            It was refused.
        """
        value = c_int()
        self._done(name, self.c.xiGetParamInt(self.handle, name.encode(), ctypes.byref(value)))
        return value.value

    def real(self, name: str) -> float:
        """Read a floating-point parameter.

        Raises
        ------
        DeviceLost, DeviceError
            It was refused.
        """
        value = c_float()
        self._done(name, self.c.xiGetParamFloat(self.handle, name.encode(), ctypes.byref(value)))
        return value.value

    def text(self, name: str) -> str:
        """Read a text parameter.

        Raises
        ------
        DeviceLost, DeviceError
            It was refused.
        """
        buffer = ctypes.create_string_buffer(_TEXT_BYTES)
        self._done(name, self.c.xiGetParamString(self.handle, name.encode(), buffer, _TEXT_BYTES))
        return buffer.value.decode(errors="replace")

    def failure(self, what: str, code: int) -> DeviceError:
        """The error to raise for a code."""
        kind = DeviceLost if code in LOST else DeviceError
        return kind(self.device, f"{what}: {explain(code)}")

    def _done(self, what: str, code: int) -> None:
        if code != 0:
            raise self.failure(what, code)
