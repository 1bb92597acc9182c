"""Reads a system file, applies overrides (--set) and reports every invalid key in one error."""

from __future__ import annotations

import os
import re
import tomllib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from pydantic import ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from escape_hw.config import key_tree
from escape_hw.config.bundled import find_system
from escape_hw.config.key_tree import KeyPath
from escape_hw.config.renamed import present_key, update_document, update_override
from escape_hw.config.section import RULE_ERROR
from escape_hw.config.system import SystemConfig
from escape_hw.config.toml_text import format_value, key_lines, line_of, parse_toml
from escape_hw.deprecation import warn_renamed
from escape_hw.errors import ConfigError
from escape_hw.suggestions import closest_match, did_you_mean

#: Longest value quoted in a message, characters.
_MAX_LENGTH = 60
#: Most problems listed in one error.
_MAX_PROBLEMS = 20

#: pydantic error type -> message.
_MESSAGES = {
    "float_type": "must be a number",
    "int_type": "must be a whole number",
    "int_from_float": "must be a whole number",
    "bool_type": "must be true or false",
    "string_type": "must be text in quotes",
    "finite_number": "must be finite",
    "model_type": "must be a table",
    "dict_type": "must be a table",
    "tuple_type": "must be an array",
    "greater_than": "is out of range",
    "greater_than_equal": "is out of range",
    "less_than": "is out of range",
    "less_than_equal": "is out of range",
}


@dataclass(frozen=True, slots=True)
class ConfigProblem:
    """One invalid key: its path, its value (``None``: it is missing), the problem and the remedy."""

    path: KeyPath
    value: Any
    message: str

    def line(self, where: str) -> str:
        """The problem on one line that begins with its place, for example ``file:line``."""
        value = "" if self.value is None else f" {format_short(self.value)}"
        return f"{where}  {key_tree.format_path(self.path)}:{value}  {self.message}"


def unknown_key_problem(path: Sequence[str | int], value: Any) -> ConfigProblem:
    """Problem of a key that does not exist, with the closest key as a suggestion."""
    plain = key_tree.locate_key(path).path
    if key_tree.locate_key(plain).existing == plain:
        others = ", ".join(f"'{kind}'" for kind in key_tree.kinds_with_key(plain))
        return ConfigProblem(plain, value, f"is a key of kind = {others} only")
    return ConfigProblem(plain, value, f"unknown key{did_you_mean(key_tree.closest_key(path))}")


def problems_from(error: ValidationError) -> list[ConfigProblem]:
    """The first problems found by a validation, without repetitions, in the order of the models."""
    found: dict[tuple[KeyPath, str], ConfigProblem] = {}
    for detail in error.errors(include_url=False):
        for problem in _translate(detail):
            found.setdefault((problem.path, problem.message), problem)
        if len(found) > _MAX_PROBLEMS:
            break
    return list(found.values())


def format_short(value: Any) -> str:
    """A value as TOML text of limited length."""
    try:
        text = format_value(value)
    except TypeError:
        text = str(value)
    return text if len(text) <= _MAX_LENGTH else text[: _MAX_LENGTH - 3] + "..."


def _translate(detail: ErrorDetails) -> list[ConfigProblem]:
    kind, value = detail["type"], detail["input"]
    place = key_tree.locate_key(detail["loc"])
    path, field, existing = place.path, place.field, place.existing
    if kind == RULE_ERROR:
        violations = detail["ctx"]["violations"]
        return [ConfigProblem((*path, *one.key.split(".")), one.value, one.message) for one in violations]
    if kind == "extra_forbidden":
        return [unknown_key_problem(detail["loc"], value)]
    if kind == "union_tag_invalid":
        return [_wrong_kind((*path, "kind"), value, field)]
    if field is None:
        return [ConfigProblem(path, value, _message(detail))]
    if key_tree.is_free_table(field) and kind != "dict_type":
        return [ConfigProblem(existing, value, "must be text, a number, true or false")]
    item = existing[-1] if isinstance(existing[-1], int) else None
    allowed = key_tree.range_text(field, item)
    hints = [f"allowed range {allowed}"] if allowed else []
    if kind == "missing":
        if item is not None:
            text = f"has too few items; expected: {field.description}"
            return [ConfigProblem(existing[:-1], list(value), text)]
        hints.insert(0, field.description or "")
        return [ConfigProblem(path, None, f"is missing ({'; '.join(hints)})")]
    if kind == "literal_error":
        return [ConfigProblem(path, value, _wrong_choice(detail))]
    if kind == "string_pattern_mismatch":
        return [ConfigProblem(path, value, f"is not allowed; expected: {field.description}")]
    if kind == "layout":
        return [ConfigProblem(path, value, _message(detail))]
    hint = f" ({'; '.join(hints)})" if hints else ""
    return [ConfigProblem(existing, value, _message(detail) + hint)]


def _message(detail: ErrorDetails) -> str:
    return _MESSAGES.get(detail["type"], detail["msg"][:1].lower() + detail["msg"][1:])


def _wrong_kind(path: KeyPath, table: Any, field: FieldInfo | None) -> ConfigProblem:
    kinds = [] if field is None else list(key_tree.sections_of(field.annotation))
    value = table["kind"]
    hint = did_you_mean(closest_match(str(value), kinds))
    return ConfigProblem(path, value, f"must be {' or '.join(map(repr, kinds))}{hint}")


def _wrong_choice(detail: ErrorDetails) -> str:
    expected = detail["ctx"]["expected"]
    choices = [choice.strip("'") for choice in expected.replace(" or ", ", ").split(", ")]
    return f"must be {expected}{did_you_mean(closest_match(str(detail['input']), choices))}"


#: Text accepted without quotes, which a shell removes: words, paths, network addresses.
_BARE_WORD = re.compile(r"^(?:[A-Za-z_/~.][\w./~ :,+-]*|\d{1,3}(?:\.\d{1,3}){3})$")
#: The same for a key that takes text, such as a serial number: any number, and what begins with a digit.
_BARE_TEXT = re.compile(r"^(?!(?:true|false)$)[\w/~.+-][\w./~ :,+-]*$")


@dataclass(frozen=True, slots=True)
class Override:
    """One override: path of the key, value, and origin (``--set``, ``--seed``)."""

    path: tuple[str, ...]
    value: Any
    origin: str = "--set"


def parse_override(text: str, within: tuple[str, ...] = ()) -> Override:
    """Parse ``key=value``; the value is TOML or a bare word.

    Where the key takes text only, numbers need no quotes and keep their zeros. ``within``: section of the
    configuration that contains the key.

    Raises
    ------
    ConfigError
        The text is not of this form.
    """
    key, equals, raw = text.partition("=")
    path = tuple(part.strip() for part in key.split("."))
    if not equals or not all(path):
        raise ConfigError(f"--set  {text!r} is not of the form section.key=value")
    raw = raw.strip()
    if _BARE_TEXT.match(raw) and key_tree.takes_text_only((*within, *path)):
        return Override(path, raw)
    try:
        document = parse_toml(f"value = {raw}")
    except tomllib.TOMLDecodeError as error:
        if not _BARE_WORD.match(raw):
            raise ConfigError(f"--set  {key.strip()}: {raw}  is not a TOML value: {error}") from None
        return Override(path, raw)
    if set(document) != {"value"}:
        raise ConfigError(f"--set  {key.strip()}: {raw!r}  must be one value on one line")
    return Override(path, document["value"])


def apply_overrides(
    document: dict[str, Any], overrides: Iterable[Override]
) -> list[tuple[Override, ConfigProblem]]:
    """Apply overrides to a parsed document, in order; returns those that are not possible.

    A key may be absent from the document but must exist in the models.
    """
    problems = []
    for override in overrides:
        path, table = override.path, document
        if key_tree.locate_key(path).existing != path:
            problems.append((override, unknown_key_problem(path, override.value)))
            continue
        for depth, name in enumerate(path[:-1], start=1):
            inner = table.setdefault(name, {})
            if not isinstance(inner, dict):
                problems.append((override, ConfigProblem(path[:depth], inner, "must be a table")))
                break
            table = inner
        else:
            table[path[-1]] = override.value
    return problems


_ERROR_POSITION = re.compile(
    r"^(?P<what>.*) \(at (?:line (?P<line>\d+), column \d+|end of document)\)$", re.DOTALL
)


def load_system(
    system: str | os.PathLike[str],
    *,
    overrides: Sequence[str] = (),
    seed: int | None = None,
    mode: str | None = None,
) -> SystemConfig:
    """Load the configuration of a system by its name or from a file.

    Parameters
    ----------
    system
        Name of a bundled system, or path of a TOML file.
    overrides
        ``section.key=value``, applied in order.
    seed, mode
        Replace ``system.seed`` and ``system.mode``.

    Raises
    ------
    ConfigError
        One line per problem: file and line (or ``--set``), key, value, remedy.

    Warns
    -----
    RenamedWarning
        A key or value has its name of an earlier version, see :mod:`escape_hw.config.renamed`.
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
    """Load a configuration from TOML text; ``source`` names it in messages. See :func:`load_system`."""
    changes, lines = _parse_changes(overrides, seed, mode)
    try:
        document = parse_toml(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError("\n".join([_syntax_line(error, text, source), *lines])) from None
    places = key_lines(text)
    for key, message in update_document(document):
        warn_renamed(f"{source}:{places.get(tuple(key.split('.')), 1)}  {message}")
    # A line counts for the present name of its key.
    places = {present_key(path): line for path, line in places.items()} | places
    rejected = apply_overrides(document, changes)
    problems: list[ConfigProblem] = []
    config = None
    try:
        config = SystemConfig.model_validate(document)
    except ValidationError as error:
        problems = problems_from(error)
    messages = [
        *(problem.line(_origin_of(problem.path, places, source, changes)) for problem in problems),
        *lines,
        *(problem.line(change.origin) for change, problem in rejected),
    ]
    if config is None or messages:
        if len(messages) > _MAX_PROBLEMS:
            messages[_MAX_PROBLEMS:] = [
                f"{source}  has further problems; the first {_MAX_PROBLEMS} are listed"
            ]
        raise ConfigError("\n".join(messages))
    return config


def _parse_changes(
    overrides: Sequence[str], seed: int | None, mode: str | None
) -> tuple[list[Override], list[str]]:
    changes, lines = [], []
    for text in overrides:
        try:
            override = parse_override(text)
        except ConfigError as error:
            lines.append(str(error))
            continue
        path, value, renamings = update_override(override.path, override.value)
        for _, message in renamings:
            warn_renamed(f"{override.origin}  {message}")
        changes.append(Override(path, value, override.origin))
    if seed is not None:
        changes.append(Override(("system", "seed"), seed, "--seed"))
    if mode is not None:
        changes.append(Override(("system", "mode"), mode, "--mode"))
    return changes, lines


def _origin_of(path: KeyPath, places: dict[KeyPath, int], source: str, changes: list[Override]) -> str:
    for change in reversed(changes):
        if path[: len(change.path)] == change.path:
            return change.origin
    line = line_of(places, path)
    return source if line is None else f"{source}:{line}"


def _syntax_line(error: tomllib.TOMLDecodeError, text: str, source: str) -> str:
    match = _ERROR_POSITION.match(str(error))
    if match is None:
        return f"{source}  is not valid TOML: {error}"
    line = match["line"] or max(1, len(text.splitlines()))
    return f"{source}:{line}  is not valid TOML: {match['what']}"
