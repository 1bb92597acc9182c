"""Pages of the documentation that are written from the code itself."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import typer.cli
import typer.main

from escape_hw.cli.app import app
from escape_hw.config.templates import json_schema

#: Folder of the pages inside the documentation; not tracked, written by every build.
FOLDER = "reference/_generated"
#: Words for the types of a schema.
_WORDS = {
    "number": "number",
    "integer": "whole number",
    "string": "text",
    "boolean": "true, false",
    "array": "list",
}


def write_pages(docs: Path) -> None:
    """Write every page whose text has changed, and remove autosummary's pages of names no longer listed.

    A page of a name that was removed or renamed would be read by every later build, with warnings.
    """
    folder = docs / FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    api = (docs / "reference" / "api.md").read_text(encoding="utf-8")
    listed = set(re.findall(r"^   ([\w.]+)$", api, re.MULTILINE))
    for page in folder.glob("*.rst"):
        if page.stem.partition(".")[2] not in listed:
            page.unlink()
    for name, text in (
        ("configuration.md", "\n".join(configuration_page())),
        ("command-line.md", command_line_page()),
    ):
        page = folder / name
        if not page.exists() or page.read_text(encoding="utf-8") != text:
            page.write_text(text, encoding="utf-8")


def command_line_page() -> str:
    """Every command with its arguments and options, as their help gives them."""
    command = typer.main.get_command(app)
    context = command.make_context("escape", [], resilient_parsing=True)
    return typer.cli.get_docs_for_click(obj=command, ctx=context, name="escape", title="Command line")


def configuration_page() -> Iterator[str]:
    """Every key of a system's file, from the schema that checks it."""
    schema = json_schema()
    yield "# Configuration keys"
    yield ""
    yield "Written from the schema that checks the files (`escape config schema` prints it for editors)."
    yield "A key without a default has to be given. `--set SECTION.KEY=VALUE` overrides any of them."
    for key, section in schema["properties"].items():
        yield from _section(key, section, schema["$defs"])


def _section(path: str, entry: dict[str, Any], known: dict[str, Any]) -> Iterator[str]:
    for name, section in _objects(entry, known):
        plain, nested = [], []
        for key, value in section.get("properties", {}).items():
            (nested if any(True for _ in _objects(value, known)) else plain).append((key, value))
        yield from ("", f"## `[{path}]`" + (f' with `kind = "{name}"`' if name else ""), "")
        yield section.get("description", "")
        if plain:
            yield from ("", "| key | default | allowed | meaning |", "|---|---|---|---|")
            required = section.get("required", ())
            for key, value in plain:
                default = "" if key in required or "default" not in value else f"`{_toml(value['default'])}`"
                text = str(value.get("description", "")).replace("|", "\\|").replace("*", "\\*")
                yield f"| `{key}` | {default} | {_format_choices(value)} | {text} |"
        for key, value in nested:
            yield from _section(f"{path}.{key}", value, known)


def _objects(entry: dict[str, Any], known: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    """The sections that a key may hold; with their kind where there is a choice."""
    choices = entry.get("oneOf") or entry.get("anyOf") or entry.get("allOf") or [entry]
    for choice in choices:
        target = known.get(choice["$ref"].rsplit("/", 1)[-1], {}) if "$ref" in choice else choice
        if target.get("type") == "object" and "properties" in target:
            yield (
                (str(target["properties"].get("kind", {}).get("const", "")) if len(choices) > 1 else ""),
                target,
            )


def _format_choices(value: dict[str, Any]) -> str:
    options = value.get("anyOf", [value])
    parts = []
    for one in options:
        if "enum" in one:
            parts.append(", ".join(f"`{_toml(word)}`" for word in one["enum"]))
        elif "const" in one:
            parts.append(f"`{_toml(one['const'])}`")
        elif one.get("type") == "null":
            parts.append("absent")
        else:
            parts.append(_range(one))
    return " or ".join(part for part in parts if part)


def _range(one: dict[str, Any]) -> str:
    text = _WORDS.get(str(one.get("type")), "")
    low, high = (
        one.get("exclusiveMinimum", one.get("minimum")),
        one.get("exclusiveMaximum", one.get("maximum")),
    )
    if low is not None:
        text += f", {'>' if 'exclusiveMinimum' in one else '≥'} {low}"
    if high is not None:
        text += f", {'<' if 'exclusiveMaximum' in one else '≤'} {high}"
    return text


def _toml(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if value is None:
        return "absent"
    return f'"{value}"' if isinstance(value, str) else str(value)
