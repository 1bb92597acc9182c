"""Completion of names in a shell: systems, TOML files and drivers."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import typer

from escape_hw.config.bundled import bundled_systems


def complete_system(incomplete: str) -> list[str]:
    """The bundled systems, TOML files and folders whose names begin with ``incomplete``."""
    return [name for name in bundled_systems() if name.startswith(incomplete)] + _toml_files(incomplete)


def complete_driver(ctx: typer.Context, incomplete: str) -> list[str]:
    """The installed drivers of the devices that a group of commands is for."""
    # Reads the entry points of all installed packages and imports the drivers: only when asked for.
    from escape_hw.api.adaptive_secondary import AdaptiveSecondary
    from escape_hw.api.camera import Camera
    from escape_hw.api.device import Device
    from escape_hw.api.mirror import DeformableMirror
    from escape_hw.api.modulator import TipTiltModulator
    from escape_hw.config.registry import drivers_of

    kinds: dict[str | None, type[Any]] = {
        "asm": AdaptiveSecondary, "camera": Camera, "dm": DeformableMirror, "modulator": TipTiltModulator,
    }  # fmt: skip
    group = None if ctx.parent is None else ctx.parent.info_name
    return [name for name in drivers_of(kinds.get(group, Device)) if name.startswith(incomplete)]


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
