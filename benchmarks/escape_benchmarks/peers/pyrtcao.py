"""pyRTC (``pyrtcao``) as a peer, where it is installed."""

from __future__ import annotations

import os
from functools import cache
from importlib import import_module
from importlib.metadata import version
from typing import Any

NOT_INSTALLED = "pyrtcao is not installed; get it with: pip install 'escape-hw[bench]'"


@cache
def import_pyrtc(module: str) -> Any | None:
    """A module of pyRTC, or ``None`` where the package is not installed."""
    # Read when it is imported; its log goes to stderr and is not ours.
    os.environ.setdefault("PYRTC_LOG_LEVEL", "ERROR")
    try:
        return import_module(f"pyrtc.{module}")
    except ImportError:
        return None


def peer_name(function: str) -> str:
    """Package, version and function."""
    return f"pyrtcao {version('pyrtcao')}: {function}" if import_pyrtc("loop") else f"pyrtcao: {function}"
