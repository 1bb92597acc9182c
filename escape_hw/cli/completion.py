"""Completion of names in a shell: systems, TOML files and drivers."""

from __future__ import annotations

import os
from pathlib import Path

from escape_hw.config.bundled import bundled_systems


def complete_system(incomplete: str) -> list[str]:
    """The bundled systems, TOML files and folders whose names begin with ``incomplete``."""
    return [name for name in bundled_systems() if name.startswith(incomplete)] + _toml_files(incomplete)


def complete_driver(incomplete: str) -> list[str]:
    """The installed drivers of real devices whose names begin with ``incomplete``."""
    # The registry reads the entry points of all installed packages: only when asked for.
    from escape_hw.config.registry import DEVICES, TWIN_PREFIX, available

    return [
        name
        for name in available(DEVICES)
        if name.startswith(incomplete) and not name.startswith(TWIN_PREFIX)
    ]


def _toml_files(incomplete: str) -> list[str]:
    """TOML files, and folders with a slash, that continue a path."""
    folder, beginning = Path(incomplete or ".").parent, Path(incomplete).name
    if incomplete.endswith("/"):
        folder, beginning = Path(incomplete), ""
    if not folder.is_dir() or not os.access(folder, os.R_OK | os.X_OK):
        return []
    entries = (
        entry for entry in sorted(folder.iterdir())
        if entry.name.startswith(beginning) and (beginning or not entry.name.startswith("."))
    )  # fmt: skip
    return [f"{entry}/" if entry.is_dir() else str(entry) for entry in entries
            if entry.is_dir() or entry.suffix == ".toml"]  # fmt: skip
