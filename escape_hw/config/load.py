"""Reads a system's configuration and reports everything that is wrong with it at once."""

from __future__ import annotations

import os
import re
import tomllib
from collections.abc import Sequence
from typing import Any

from pydantic import ValidationError

from escape_hw.config.bundled import find_system
from escape_hw.config.locate import key_lines, line_of
from escape_hw.config.models import SystemConfig
from escape_hw.config.outline import Path
from escape_hw.config.overrides import Override, apply, parse_override
from escape_hw.config.problems import Problem, problems_of
from escape_hw.errors import ConfigError

_PLACE = re.compile(r"^(?P<what>.*) \(at (?:line (?P<line>\d+), column \d+|end of document)\)$", re.DOTALL)


def load_system(
    system: str | os.PathLike[str],
    *,
    overrides: Sequence[str] = (),
    seed: int | None = None,
    mode: str | None = None,
) -> SystemConfig:
    """Read a system by its name or from a file.

    Parameters
    ----------
    system
        Name of a bundled system, or path of a TOML file.
    overrides
        ``section.key=value`` each, applied in order.
    seed, mode
        Replace ``system.seed`` and ``system.mode``.

    Raises
    ------
    ConfigError
        One line for each problem: file and line (or ``--set``), key, value, what to do.
    """
    text, source = find_system(system)
    return load_text(text, source, overrides=overrides, seed=seed, mode=mode)


def load_text(
    text: str,
    source: str = "<text>",
    *,
    overrides: Sequence[str] = (),
    seed: int | None = None,
    mode: str | None = None,
) -> SystemConfig:
    """Read a configuration from TOML text; see :func:`load_system`.

    Parameters
    ----------
    text
        The TOML document.
    source
        What to call it in messages.
    """
    changes, lines = _changes(overrides, seed, mode)
    try:
        document = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError("\n".join([_syntax_line(error, text, source), *lines])) from None
    return _validate(document, key_lines(text), source, changes, lines)


def _validate(
    document: dict[str, Any], places: dict[Path, int], source: str, changes: list[Override], lines: list[str]
) -> SystemConfig:
    refused = apply(document, changes)
    problems: list[Problem] = []
    config = None
    try:
        config = SystemConfig.model_validate(document)
    except ValidationError as error:
        problems = problems_of(error)
    found = [
        *(problem.line(_where(problem.path, places, source, changes)) for problem in problems),
        *lines,
        *(problem.line(change.origin) for change, problem in refused),
    ]
    if config is None or found:
        raise ConfigError("\n".join(found))
    return config


def _changes(
    overrides: Sequence[str], seed: int | None, mode: str | None
) -> tuple[list[Override], list[str]]:
    changes, lines = [], []
    for text in overrides:
        try:
            changes.append(parse_override(text))
        except ConfigError as error:
            lines.append(str(error))
    if seed is not None:
        changes.append(Override(("system", "seed"), seed, "--seed"))
    if mode is not None:
        changes.append(Override(("system", "mode"), mode, "--mode"))
    return changes, lines


def _where(path: Path, places: dict[Path, int], source: str, changes: list[Override]) -> str:
    for change in reversed(changes):
        if path[: len(change.path)] == change.path:
            return change.origin
    line = line_of(places, path)
    return source if line is None else f"{source}:{line}"


def _syntax_line(error: tomllib.TOMLDecodeError, text: str, source: str) -> str:
    match = _PLACE.match(str(error))
    if match is None:
        return f"{source}  is not valid TOML: {error}"
    line = match["line"] or max(1, len(text.splitlines()))
    return f"{source}:{line}  is not valid TOML: {match['what']}"
