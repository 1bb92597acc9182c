"""Writing of TOML text, and line numbers of its keys."""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Iterator, Mapping
from typing import Any

#: Path of a key: names of tables and keys, numbers of array items.
KeyPath = tuple[str | int, ...]


#: Deepest nesting of tables and arrays, and longest statement and text whose lines are numbered.
_MAX_DEPTH, _MAX_STATEMENT_LINES, _MAX_LINES = 32, 1000, 20_000


def parse_toml(text: str) -> dict[str, Any]:
    """Parse TOML text.

    Raises
    ------
    tomllib.TOMLDecodeError
        It is not valid, nested too deeply, or holds a number that is too long; other errors of the parser
        are not raised.
    """
    try:
        document = tomllib.loads(text)
    except RecursionError:
        raise tomllib.TOMLDecodeError("nested too deeply") from None
    except tomllib.TOMLDecodeError:
        raise
    except ValueError as error:
        raise tomllib.TOMLDecodeError(f"a number is too long ({error})") from None
    layer: list[Any] = [document]
    for _ in range(_MAX_DEPTH):
        tables = [one for one in layer if isinstance(one, (dict, list))]
        layer = [inner for one in tables for inner in (one.values() if isinstance(one, dict) else one)]
        if not layer:
            return document
    raise tomllib.TOMLDecodeError(f"nested more than {_MAX_DEPTH} levels deep")


def key_lines(text: str) -> dict[KeyPath, int]:
    """Line number, from 1, of each key and each table of a valid TOML text.

    A statement ends at the first line end at which it parses, so no separate scanner is needed. Lines after
    a very long statement, or of a very long text, are not numbered.
    """
    lines: dict[KeyPath, int] = {}
    table: KeyPath = ()
    counts: dict[KeyPath, int] = {}
    for number, statement in _statements(text):
        content = tomllib.loads(statement)
        if not statement.lstrip().startswith("["):
            _record_lines(lines, table, content, number)
            continue
        table = ()
        inner: Any = content
        while inner:
            (name, inner), *_ = inner.items()
            table = (*table, name)
            if isinstance(inner, list):
                counts[table] = counts.get(table, -1) + 1
                inner = inner[0]
            lines.setdefault(table, number)
            if table in counts:
                table = (*table, counts[table])
                lines.setdefault(table, number)
    return lines


def line_of(lines: dict[KeyPath, int], path: KeyPath) -> int | None:
    """Line of a key, or of the innermost enclosing table."""
    for length in range(len(path), 0, -1):
        if path[:length] in lines:
            return lines[path[:length]]
    return None


def _statements(text: str) -> Iterator[tuple[int, str]]:
    pending: list[str] = []
    start = 1
    for number, line in enumerate(text.splitlines()[:_MAX_LINES], start=1):
        if len(pending) >= _MAX_STATEMENT_LINES:
            return
        if not pending:
            if not line.strip() or line.lstrip().startswith("#"):
                continue
            start = number
        pending.append(line)
        statement = "\n".join(pending)
        try:
            tomllib.loads(statement)
        except tomllib.TOMLDecodeError:
            continue
        yield start, statement
        pending = []


def _record_lines(lines: dict[KeyPath, int], table: KeyPath, content: Any, number: int) -> None:
    items = content.items() if isinstance(content, dict) else enumerate(content)
    for name, value in items:
        path = (*table, name)
        lines.setdefault(path, number)
        if isinstance(value, (dict, list)):
            _record_lines(lines, path, value, number)


_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")
_ESCAPES = {"\b": "\\b", "\t": "\\t", "\n": "\\n", "\f": "\\f", "\r": "\\r", '"': '\\"', "\\": "\\\\"}


def dump_toml(table: Mapping[str, Any]) -> str:
    """Nested tables of plain values as ASCII TOML text that parses to an equal table.

    Raises
    ------
    TypeError
        A value has no TOML form.
    """
    return "\n".join(_lines(table, ())).lstrip("\n") + "\n"


def _lines(table: Mapping[str, Any], path: tuple[str, ...]) -> Iterator[str]:
    plain = {k: v for k, v in table.items() if not isinstance(v, Mapping)}
    if path and (plain or not table):
        yield ""
        yield "[" + ".".join(map(format_key, path)) + "]"
    for key, value in plain.items():
        yield f"{format_key(key)} = {format_value(value)}"
    for key, value in table.items():
        if isinstance(value, Mapping):
            yield from _lines(value, (*path, key))


def format_key(key: str) -> str:
    """A key, quoted if necessary."""
    return key if _BARE_KEY.fullmatch(key) else _quote(key)


def format_value(value: Any) -> str:
    """A plain value as TOML; raises :class:`TypeError` if it has no TOML form."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        return "nan" if math.isnan(value) else repr(value)
    if isinstance(value, str):
        return _quote(value)
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(format_value, value)) + "]"
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{format_key(k)} = {format_value(v)}" for k, v in value.items()) + "}"
    raise TypeError(f"{value!r} has no TOML form")


def _quote(text: str) -> str:
    return '"' + "".join(map(_escape, text)) + '"'


def _escape(char: str) -> str:
    if char in _ESCAPES:
        return _ESCAPES[char]
    if " " <= char <= "~":
        return char
    code = ord(char)
    return f"\\u{code:04X}" if code < 0x10000 else f"\\U{code:08X}"
