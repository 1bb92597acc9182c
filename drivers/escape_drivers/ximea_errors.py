"""What the error codes of XIMEA's xiAPI mean, and what to do about them."""

from __future__ import annotations

_PLUG = "check cable and power, then open the camera again"
_OTHER = "another process holds it: close that one; after a crash unplug the camera and plug it in again"

#: Code: what happened and, where one is known, the way out.
ERRORS: dict[int, tuple[str, str]] = {
    1: ("invalid handle", _PLUG),
    9: ("no image", ""),
    10: ("time-out", ""),
    11: ("bad arguments", "the value is outside what the camera takes with its other settings"),
    12: ("not supported", ""),
    13: ("buffers cannot be attached", "raise usbcore.usbfs_memory_mb, see docs/devices/ximea.md"),
    15: ("not enough memory", "raise usbcore.usbfs_memory_mb, see docs/devices/ximea.md"),
    41: ("acquisition runs already", ""),
    45: ("acquisition is stopped", ""),
    49: ("not ready", ""),
    55: ("the camera was reset", "its settings are gone; open it again"),
    56: ("no such camera", "check serial number, cable, permissions (udev) and usbfs memory"),
    57: ("the camera is locked", _OTHER),
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
#: The camera has gone, or has forgotten everything; only opening it again helps.
LOST = frozenset({1, 55, 56})


def explain(code: int) -> str:
    """One line: code, meaning, and the way out."""
    meaning, way_out = ERRORS.get(code, ("unknown error", "see the list of codes in the vendor's xiApi.h"))
    return f"error {code}, {meaning}{'; ' if way_out else ''}{way_out}"
