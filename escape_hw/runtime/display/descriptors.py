"""File descriptors of the standard streams."""

from __future__ import annotations

import os


def redirect_to_null(descriptor: int) -> None:
    """Let everything written to ``descriptor`` go to the null device.

    What a stream still holds is flushed when the interpreter exits. If that fails, Python ends with exit code
    120, so a descriptor whose reader is gone is redirected.
    """
    null = os.open(os.devnull, os.O_WRONLY)
    if null != descriptor:
        os.dup2(null, descriptor)
        os.close(null)
    else:
        os.set_inheritable(descriptor, True)
