"""``--set a.b.c=value``: overrides for any key of the configuration."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from escape_hw.config import outline
from escape_hw.config.problems import Problem, show, unknown_key
from escape_hw.errors import ConfigError

#: Text that may stand without quotes, since a shell takes them away: words, paths, network addresses.
_WORD = re.compile(r"^(?:[A-Za-z_/~.][\w./~ :+-]*|\d{1,3}(?:\.\d{1,3}){3})$")


@dataclass(frozen=True, slots=True)
class Override:
    """One override: the key's path, its value, and where it came from (``--set``, ``--seed``)."""

    path: tuple[str, ...]
    value: Any
    origin: str = "--set"


def parse_override(text: str) -> Override:
    """Read ``key=value``; the value is TOML, and a bare word is text.

    Raises
    ------
    ConfigError
        There is no ``=``, or either side cannot be read.
    """
    key, equals, raw = text.partition("=")
    path = tuple(part.strip() for part in key.split("."))
    if not equals or not all(path):
        raise ConfigError(f"--set  {text!r} is not of the form section.key=value")
    raw = raw.strip()
    try:
        document = tomllib.loads(f"value = {raw}")
    except tomllib.TOMLDecodeError as error:
        if not _WORD.match(raw):
            raise ConfigError(f"--set  {key.strip()}: {raw}  is not a TOML value: {error}") from None
        return Override(path, raw)
    if set(document) != {"value"}:
        raise ConfigError(f"--set  {key.strip()}: {raw!r}  must be one value on one line")
    return Override(path, document["value"])


def apply(document: dict[str, Any], overrides: Iterable[Override]) -> list[tuple[Override, Problem]]:
    """Put overrides into a parsed document, in order, and report those that cannot be.

    Keys that the document leaves out may be set as long as the models have them.
    """
    problems = []
    for override in overrides:
        problem = _apply(document, override)
        if problem is not None:
            problems.append((override, problem))
    return problems


def _apply(document: dict[str, Any], override: Override) -> Problem | None:
    if outline.place_of(override.path).known != override.path:
        return unknown_key(override.path, override.value)
    table = document
    for depth, name in enumerate(override.path[:-1], start=1):
        inner = table.setdefault(name, {})
        if not isinstance(inner, dict):
            return Problem(override.path[:depth], show(inner), "must be a table")
        table = inner
    table[override.path[-1]] = override.value
    return None
