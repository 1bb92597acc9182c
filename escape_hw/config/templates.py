"""JSON schema and commented starter file, generated from the models."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from escape_hw.config.key_tree import fields_of, is_free_table, range_text, sections_of
from escape_hw.config.loader import load_system
from escape_hw.config.system import SystemConfig
from escape_hw.config.toml_text import dump_toml, format_key, format_value


def json_schema() -> dict[str, Any]:
    """JSON schema of a system file with ranges, defaults and descriptions."""
    schema = SystemConfig.model_json_schema(by_alias=True)
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "ESCAPE system",
        **{key: value for key, value in schema.items() if key != "title"},
    }


def starter_text(name: str = "my-system", base: str = "razor-shwfs") -> str:
    """A complete system file with the meaning, unit and range of every key as comments.

    The values are those of the bundled system ``base``.

    Raises
    ------
    ConfigError
        The base does not exist, or the name is not valid.
    """
    config = load_system(base, overrides=[f"system.name={format_value(name)}"])
    lines = [
        f"# Created as a copy of {base}. Keys equal to their default may be removed;",
        "# a key after '#' is absent, which switches its rule or device off.",
        *_section(config, ()),
    ]
    return "\n".join(lines) + "\n"


def _section(section: BaseModel, path: tuple[str, ...]) -> Iterator[str]:
    tables = []
    if path:
        yield "[" + ".".join(map(format_key, path)) + "]"
    for (key, field), attribute in zip(
        fields_of(type(section)).items(), type(section).model_fields, strict=True
    ):
        value = getattr(section, attribute)
        if isinstance(value, BaseModel) or (value is not None and is_free_table(field)):
            tables.append((key, field, value))
        elif value is not None:
            yield f"# {_help(field)}"
            yield f"{format_key(key)} = {format_value(value)}"
        elif not sections_of(field.annotation):
            yield f"# {_help(field)}"
            yield f"# {format_key(key)} ="
    for key, field, value in tables:
        yield ""
        yield f"# {_help(field)}"
        if isinstance(value, BaseModel):
            yield from _section(value, (*path, key))
        else:
            yield "[" + ".".join(map(format_key, (*path, key))) + "]"
            if value:
                yield dump_toml(value).rstrip()


def _help(field: FieldInfo) -> str:
    allowed = range_text(field)
    return f"{field.description}" + (f" ({allowed})" if allowed else "")
