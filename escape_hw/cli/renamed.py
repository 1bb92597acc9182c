"""Commands and options of version 0.1.0, accepted with a line on standard error."""

from __future__ import annotations

from collections.abc import Sequence

import typer

_COMMANDS = {"rehearse": "with-stand-ins"}
#: Options by command.
_OPTIONS = {
    "sweep": {
        "--drop": "--dropped-modes", "--heats": "--replicates", "--finals": "--final-replicates"
    },
    "reproduce": {"--plants": "--realisations"},
    "import": {"--legacy": "--frame-order"},
}  # fmt: skip


def current_words(words: Sequence[str]) -> list[str]:
    """The words of a command line with old commands and options replaced; nothing after ``--`` changes."""
    if not words:
        return []
    command, *rest = words
    found = [_replace(command, _COMMANDS)]
    options = _OPTIONS.get(command, {})
    end = rest.index("--") if "--" in rest else len(rest)
    for word in rest[:end]:
        name, equals, value = word.partition("=")
        found.append(_replace(name, options) + equals + value)
    return [*found, *rest[end:]]


def _replace(old: str, names: dict[str, str]) -> str:
    if old not in names:
        return old
    typer.echo(f"deprecated: {old} is called {names[old]}; the next version removes the old name", err=True)
    return names[old]
