"""Packages that only interchange needs, imported when it does."""

from __future__ import annotations

import importlib
from typing import Any

from escape_hw.errors import ConfigError

#: Import name -> name on the package index, where they differ.
_INDEX_NAMES = {"yaml": "PyYAML", "pyrtc": "pyrtcao"}


def import_optional(name: str, purpose: str) -> Any:
    """Import an optional package; ``purpose`` begins the sentence that says what it is needed for.

    Raises
    ------
    ConfigError
        The package is not installed or cannot be imported.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        package = _INDEX_NAMES.get(name, name)
        if (error.name or "").partition(".")[0] == name:
            raise ConfigError(
                f"{purpose} needs the Python package '{package}', which is not installed; "
                "install it with: pip install 'escape-hw[interchange]'"
            ) from error
        raise ConfigError(f"{purpose} needs the Python package '{package}', which fails: {error}") from error
