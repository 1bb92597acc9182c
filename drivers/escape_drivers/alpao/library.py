"""Binding of ALPAO's libasdk: prototypes, error numbers and their explanations, errors raised as exceptions.

Prototypes follow the public headers asdkDM.h, asdkType.h and asdkErrNo.h: ``Scalar`` is double, ``UInt``
uint32, ``COMPL_STAT`` an int (0 success, -1 failure), ``asdkDM`` opaque.
"""

from __future__ import annotations

import ctypes
from ctypes import POINTER, c_char_p, c_double, c_int, c_size_t, c_uint32, c_void_p
from typing import Any

from escape_drivers.common.vendor_library import LoadedLibrary, Prototypes
from escape_hw.api.discovery import VendorLibrary
from escape_hw.errors import DeviceError

_CONFIGURATION_HINT = "its configuration files (serial number .acfg and binary) must lie where ACECFG points"
_PATTERN_HINT = "after a triggered sequence, stop_pattern() first"
_CABLE_HINT = "check power, cable and the interface's address"

#: Number: what happened and, where one is known, the way out.
ERRORS: dict[int, tuple[str, str]] = {
    0x001: ("not enough memory", ""),
    0x002: ("too many mirrors are open", "close another one"),
    0x003: ("wrong number of actuators", "check the configuration files of the mirror"),
    0x004: ("already in use", "another process or object holds this mirror; close it there"),
    0x010: ("unknown parameter name", "this version of the SDK may be too old for it"),
    0x011: ("value out of range", ""),
    0x020: ("the interface library cannot be loaded", "install the SDK's plug-in for this interface"),
    0x021: ("the interface library is unsuitable", "SDK and plug-in must have the same version"),
    0x022: ("no interface in the configuration", _CONFIGURATION_HINT),
    0x023: ("no reader for the configuration", _CONFIGURATION_HINT),
    0x024: ("the binary configuration cannot be opened", _CONFIGURATION_HINT),
    0x025: ("the binary configuration cannot be read", _CONFIGURATION_HINT),
    0x026: ("unknown entry in the configuration", _CONFIGURATION_HINT),
    0x027: ("the .acfg file cannot be opened", _CONFIGURATION_HINT),
    0x028: ("unknown entry in the .acfg file", _CONFIGURATION_HINT),
    0x029: ("an entry of the .acfg file has no value", _CONFIGURATION_HINT),
    0x030: ("wrong number of mirrors", ""),
    0x031: ("no mirror of this index", ""),
    0x032: ("not supported yet", ""),
    0x100: ("a parameter is missing", ""),
    0x101: ("the interface is not connected", f"{_CABLE_HINT}, then open the mirror again"),
    0x102: ("time-out of the output", f"{_CABLE_HINT}; {_PATTERN_HINT}"),
    0x103: ("time-out of the input", _CABLE_HINT),
    0x104: ("output failed", f"{_CABLE_HINT}; {_PATTERN_HINT}"),
    0x105: ("input failed", _CABLE_HINT),
    0x106: ("asynchronous output could not be checked", "stop the pattern first"),
    0x107: ("asynchronous input could not be checked", "stop the pattern first"),
    0x108: ("the output buffer could not be cleared", _CABLE_HINT),
    0x109: ("the input buffer could not be cleared", _CABLE_HINT),
    0x10A: ("not supported by this interface", "take the option out of the device's configuration"),
    0x10B: ("the interface's driver failed", "check the driver of the interface card"),
    0x10C: ("wrong size of the output buffer", ""),
    0x10D: ("no acknowledgement in time", f"{_CABLE_HINT}, or allow a longer ack_timeout_ms"),
    0x10E: ("no trigger in time", "check the trigger's cable, or set trigger_in to 'off'"),
}


def describe_error(number: int, text: str) -> str:
    """One line: number, meaning, the library's own text, and the way out."""
    meaning, remedy = ERRORS.get(number, ("unknown error", ""))
    library_text = f"; library: {text}" if text and text.lower() != meaning else ""
    return f"error 0x{number:X}, {meaning}{library_text}{'; ' if remedy else ''}{remedy}"


#: Errors of a parameter that this SDK, interface or electronics do not have.
_NOT_SUPPORTED = frozenset({0x010, 0x032, 0x10A})

SDK = VendorLibrary(
    "ALPAO SDK", ("libasdk.so",), "ESCAPE_ALPAO_LIBRARY", "install the SDK that came with the mirror"
)
_PROTOTYPES: Prototypes = {
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
_MAX_STACKED_ERRORS = 64
_TEXT_BYTES = 1024


class AlpaoLibrary(LoadedLibrary):
    """The SDK, loaded; every method but :meth:`init` works on an ``asdkDM`` handle."""

    VENDOR, PROTOTYPES, LOST_CODES = SDK, _PROTOTYPES, frozenset({0x101})

    def init(self, serial: str) -> c_void_p:
        """Connect to the mirror of a serial number.

        A handle alone does not mean success: without a configuration the SDK may give one all the
        same. So the error stack decides. A handle given after an error is released, and never reset: the
        SDK may crash on that.
        """
        stale = self._clear_errors()
        handle = self.c.asdkInit(serial.encode())
        error = self.last_error()
        if handle and (error is None or error == stale):
            return c_void_p(handle)
        if handle:
            self.c.asdkRelease(handle)
        if error is None:
            raise DeviceError(self.device, f"the SDK did not open mirror {serial!r} and gives no reason")
        raise DeviceError(self.device, f"the SDK did not open mirror {serial!r}: {describe_error(*error)}")

    def last_error(self) -> tuple[int, str] | None:
        """Number and text of the newest error, or ``None`` when there is none."""
        number, text = c_uint32(), ctypes.create_string_buffer(_TEXT_BYTES)
        if self.c.asdkGetLastError(ctypes.byref(number), text, _TEXT_BYTES) != 0 or number.value == 0:
            return None
        return number.value, text.value.decode(errors="replace").strip()

    def _clear_errors(self) -> tuple[int, str] | None:
        """Empty the error stack, which is kept between mirrors; returns an error that cannot be removed."""
        error = None
        for _ in range(_MAX_STACKED_ERRORS):
            error = self.last_error()
            if error is None:
                return None
        return error

    def error_for(self, call: str) -> DeviceError:
        """The error to raise after a call that failed."""
        return self._describe_failure(call, self.last_error())

    def _describe_failure(self, call: str, error: tuple[int, str] | None) -> DeviceError:
        if error is None:
            return DeviceError(self.device, f"{call} failed; the SDK gives no reason")
        return self._error(error[0], f"{call} failed: {describe_error(*error)}")

    def call(self, name: str, handle: c_void_p, *arguments: Any) -> None:
        """Call a function that returns a ``COMPL_STAT``."""
        if getattr(self.c, name)(handle, *arguments) != 0:
            raise self.error_for(name)

    def get(self, handle: c_void_p, name: str) -> float:
        """Read a parameter."""
        value = c_double()
        if self.c.asdkGet(handle, name.encode(), ctypes.byref(value)) != 0:
            raise self.error_for(f"asdkGet({name})")
        return value.value

    def set(self, handle: c_void_p, name: str, value: float, *, if_supported: bool = False) -> None:
        """Write a parameter; with ``if_supported``, unless the SDK or the electronics do not have it."""
        if self.c.asdkSet(handle, name.encode(), value) == 0:
            return
        error = self.last_error()
        if not (if_supported and error is not None and error[0] in _NOT_SUPPORTED):
            raise self._describe_failure(f"asdkSet({name}, {value:g})", error)


def format_version(number: float) -> str:
    """``VersionInfo`` as people write it: 3040500612 is 3.04.05.0612."""
    whole = round(number)
    major, rest = divmod(whole, 10**9)
    minor, rest = divmod(rest, 10**7)
    patch, build = divmod(rest, 10**5)
    return f"{major}.{minor:02d}.{patch:02d}.{build:04d}"
