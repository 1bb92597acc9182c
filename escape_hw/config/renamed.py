"""Configuration keys and values of version 0.1.0 that have new names; both are accepted until version 0.3.0.

To rename a key or a value, change it in the models and add a line here.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, TypeVar

from escape_hw.deprecation import renamed_text, warn_renamed

T = TypeVar("T")

#: Old key -> its present name in the same section.
RENAMED_KEYS: dict[str, str] = {
    "calibration.actuators": "actuator_model",
    "calibration.also": "extra_parameters",
    "tracking.memory_s": "forgetting_time_s",
    "tracking.worth": "exchange_threshold",
    "tracking.limit": "exchange_limit",
    "tracking.largest_shift": "max_shift",
    "server.abandoned_s": "unattended_s",
    "server.silent_s": "engine_silence_s",
    "server.saturated_share": "saturated_fraction",
    "devices.modulator.stage.correct": "correction_source",
    "devices.modulator.stage.round_within": "circle_tolerance",
}
#: Present key -> old value -> present value.
RENAMED_VALUES: dict[str, dict[str, str]] = {
    "calibration.solver": {
        "effects": "mixed-effects",
        "light": "registration-only",
        "frozen": "frozen-derivatives",
    },
    "calibration.actuator_model": {"found": "fitted", "alike": "nominal"},
    "calibration.pokes": {"shaped": "anticorrelated"},
}


class Renaming(NamedTuple):
    """An old key or value that was found: the old key (dotted), and the message for the user."""

    key: str
    message: str


def update_document(document: dict[str, Any]) -> list[Renaming]:
    """Replace old keys and values in a parsed configuration, in place, and list what was replaced.

    An old key beside its new one stays, and is then refused as unknown.
    """
    found = []
    old_keys = {}
    for key, new in RENAMED_KEYS.items():
        table, old = _table_of(document, key)
        if old in table and new not in table:
            table[new] = table.pop(old)
            new_key = key.removesuffix(old) + new
            old_keys[new_key] = key
            found.append(Renaming(key, renamed_text(key, new_key)))
    for key, values in RENAMED_VALUES.items():
        table, name = _table_of(document, key)
        value = table.get(name)
        if isinstance(value, str) and value in values:
            table[name] = values[value]
            found.append(Renaming(old_keys.get(key, key), _value_text(key, value, values[value])))
    return found


def update_override(path: Sequence[str], value: Any) -> tuple[tuple[str, ...], Any, list[Renaming]]:
    """The present path and value of one override, and what was replaced."""
    document = value
    for name in reversed(path):
        document = {name: document}
    found = update_document(document)
    present: list[str] = []
    for _ in path:
        ((name, document),) = document.items()
        present.append(name)
    return tuple(present), document, found


def present_key(path: tuple[str | int, ...]) -> tuple[str | int, ...]:
    """The path of a key under its present name."""
    new = RENAMED_KEYS.get(".".join(map(str, path)))
    return path if new is None else (*path[:-1], new)


def present_value(key: str, value: T) -> T:
    """The present name of a value of a key such as ``"calibration.solver"``; warns if it was an old one."""
    new: Any = RENAMED_VALUES.get(key, {}).get(value) if isinstance(value, str) else None
    if new is None:
        return value
    warn_renamed(_value_text(key, value, new))
    return new  # type: ignore[no-any-return]


def _value_text(key: str, old: object, new: str) -> str:
    return renamed_text(f"{key} = {old!r}", repr(new))


def _table_of(document: dict[str, Any], key: str) -> tuple[dict[str, Any], str]:
    """The table of a key (an empty one where it is missing or malformed) and the key's last part."""
    *sections, name = key.split(".")
    table: Any = document
    for section in sections:
        table = table.get(section) if isinstance(table, dict) else None
    return (table if isinstance(table, dict) else {}), name
