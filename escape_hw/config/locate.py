"""Finds the line of every key in a TOML text."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from typing import Any

#: A key's place in the document: names of tables and keys, numbers of array items.
Path = tuple[str | int, ...]


def key_lines(text: str) -> dict[Path, int]:
    """Line (counted from 1) where each key and each table of a valid TOML text begins.

    A statement ends at the first line end after which it parses by itself; that needs no scanner
    of strings, comments and brackets, and cannot disagree with the parser.
    """
    lines: dict[Path, int] = {}
    table: Path = ()
    counts: dict[Path, int] = {}
    for number, statement in _statements(text):
        content = tomllib.loads(statement)
        if not statement.lstrip().startswith("["):
            _note(lines, table, content, number)
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


def line_of(lines: dict[Path, int], path: Path) -> int | None:
    """Line of a key, or else of the nearest table around it."""
    for length in range(len(path), 0, -1):
        if path[:length] in lines:
            return lines[path[:length]]
    return None


def _statements(text: str) -> Iterator[tuple[int, str]]:
    pending: list[str] = []
    start = 1
    for number, line in enumerate(text.splitlines(), start=1):
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


def _note(lines: dict[Path, int], table: Path, content: Any, number: int) -> None:
    items = content.items() if isinstance(content, dict) else enumerate(content)
    for name, value in items:
        path = (*table, name)
        lines.setdefault(path, number)
        if isinstance(value, (dict, list)):
            _note(lines, path, value, number)
