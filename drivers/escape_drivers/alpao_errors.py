"""What the error numbers of the ALPAO SDK mean (asdkErrNo.h), and what to do about them."""

from __future__ import annotations

CONFIG = "its configuration files (serial number .acfg and binary) must lie where ACECFG points"
CABLE = "check power, cable and the interface's address"

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
    0x022: ("no interface in the configuration", CONFIG),
    0x023: ("no reader for the configuration", CONFIG),
    0x024: ("the binary configuration cannot be opened", CONFIG),
    0x025: ("the binary configuration cannot be read", CONFIG),
    0x026: ("unknown entry in the configuration", CONFIG),
    0x027: ("the .acfg file cannot be opened", CONFIG),
    0x028: ("unknown entry in the .acfg file", CONFIG),
    0x029: ("an entry of the .acfg file has no value", CONFIG),
    0x030: ("wrong number of mirrors", ""),
    0x031: ("no mirror of this index", ""),
    0x032: ("not supported yet", ""),
    0x100: ("a parameter is missing", ""),
    0x101: ("the interface is not connected", f"{CABLE}, then open the mirror again"),
    0x102: ("time-out of the output", CABLE),
    0x103: ("time-out of the input", CABLE),
    0x104: ("output failed", CABLE),
    0x105: ("input failed", CABLE),
    0x106: ("asynchronous output could not be checked", "stop the pattern first"),
    0x107: ("asynchronous input could not be checked", "stop the pattern first"),
    0x108: ("the output buffer could not be cleared", CABLE),
    0x109: ("the input buffer could not be cleared", CABLE),
    0x10A: ("not supported by this interface", "take the option out of the device's configuration"),
    0x10B: ("the interface's driver failed", "check the driver of the interface card"),
    0x10C: ("wrong size of the output buffer", ""),
    0x10D: ("no acknowledgement in time", f"{CABLE}, or allow a longer ack_timeout_ms"),
    0x10E: ("no trigger in time", "check the trigger's cable, or set trigger_in to 'off'"),
}
#: The mirror has gone; nothing but opening it again helps.
LOST = frozenset({0x101})


def explain(number: int, text: str) -> str:
    """One line: number, meaning, the library's own text, and the way out."""
    meaning, way_out = ERRORS.get(number, ("unknown error", ""))
    said = f"; the library says: {text}" if text and text.lower() != meaning else ""
    return f"error 0x{number:X}, {meaning}{said}{'; ' if way_out else ''}{way_out}"
