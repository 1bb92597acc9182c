"""The bundled systems, and reading a system by name or from a file."""

from __future__ import annotations

import importlib.resources
import os
from pathlib import Path

from escape_hw.bounded_files import MAX_TEXT_BYTES, read_bounded, reason_of, shorten_path
from escape_hw.errors import ConfigError
from escape_hw.suggestions import closest_match

_SUFFIX = ".toml"


def bundled_systems() -> tuple[str, ...]:
    """Sorted names of the bundled systems."""
    folder = importlib.resources.files("escape_hw.config") / "systems"
    names = (entry.name for entry in folder.iterdir())
    return tuple(sorted(name.removesuffix(_SUFFIX) for name in names if name.endswith(_SUFFIX)))


def bundled_text(name: str) -> str:
    """The TOML text of a bundled system, comments included.

    Raises
    ------
    ConfigError
        There is no such system; the message gives the closest name.
    """
    known = bundled_systems()
    if name not in known:
        suggestion = closest_match(name, known)
        hint = f"did you mean '{suggestion}'? " if suggestion else ""
        raise ConfigError(
            f"unknown system '{name}' ({hint}bundled systems: {', '.join(known)}; "
            "a file is given by its path, ending in .toml)"
        )
    file = importlib.resources.files("escape_hw.config") / "systems" / (name + _SUFFIX)
    return file.read_text(encoding="utf-8")


def find_system(system: str | os.PathLike[str]) -> tuple[str, str]:
    """The TOML text of a bundled system or of a file, and the name of its source for messages.

    The path of a file ends in ``.toml`` or contains a folder.

    Raises
    ------
    ConfigError
        Unknown name, or an unreadable file.
    """
    name = os.fspath(system)
    try:
        path = Path(name).expanduser()
    except RuntimeError as error:
        raise ConfigError(f"{name}: cannot be read ({error})") from error
    if isinstance(system, str) and path.suffix != _SUFFIX and len(path.parts) < 2:
        return bundled_text(name), name + _SUFFIX
    try:
        return read_bounded(path, MAX_TEXT_BYTES).decode("utf-8"), name
    except UnicodeDecodeError as error:
        raise ConfigError(f"{name}: is not UTF-8 text ({error.reason} at byte {error.start})") from error
    except (OSError, ValueError) as error:
        raise ConfigError(f"{shorten_path(name)}: cannot be read ({reason_of(error)})") from error
