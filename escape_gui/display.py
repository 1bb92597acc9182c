"""Whether Qt can open a window here; it aborts the process where it cannot."""

from __future__ import annotations

import ctypes.util
import os

from escape_hw.errors import ConfigError


def check_display() -> None:
    """Refuse before Qt does.

    Raises
    ------
    ConfigError
        There is no display, or a library that Qt needs for it is missing; says the way out.
    """
    if os.environ.get("QT_QPA_PLATFORM") or os.environ.get("WAYLAND_DISPLAY"):
        return
    if not os.environ.get("DISPLAY"):
        raise ConfigError(
            "no display: log in with 'ssh -X', or set QT_QPA_PLATFORM=offscreen for --screenshot without one"
        )
    if ctypes.util.find_library("xcb-cursor") is None:
        raise ConfigError("Qt needs the library libxcb-cursor: install it with 'apt install libxcb-cursor0'")
