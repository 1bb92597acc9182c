"""The keys of the configuration, found by walking the models; for messages and overrides."""

from __future__ import annotations

import types
import typing
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

from annotated_types import Ge, Gt, Le, Lt
from pydantic import BaseModel, Tag
from pydantic.fields import FieldInfo

from escape_hw.config.system import SystemConfig
from escape_hw.suggestions import closest_match

KeyPath = tuple[str | int, ...]


def format_path(path: Sequence[str | int]) -> str:
    """A path as text, ``devices.screen.screens_r0_m[2]``."""
    text = ""
    for step in path:
        text += f"[{step}]" if isinstance(step, int) else f".{step}" if text else step
    return text


def sections_of(annotation: Any) -> dict[str, type[BaseModel]]:
    """The models in an annotation: ``Model``, ``Model | None`` or a tagged union.

    Keys are the tags of a union, or an empty string for a single model.
    """
    found: dict[str, type[BaseModel]] = {}
    is_union = isinstance(annotation, types.UnionType) or typing.get_origin(annotation) is typing.Union
    for option in typing.get_args(annotation) if is_union else (annotation,):
        marks: list[Any] = []
        if typing.get_origin(option) is typing.Annotated:
            option, *marks = typing.get_args(option)
        if isinstance(option, type) and issubclass(option, BaseModel):
            found[next((mark.tag for mark in marks if isinstance(mark, Tag)), "")] = option
    return found


def fields_of(section: type[BaseModel]) -> dict[str, FieldInfo]:
    """The fields of a section by their names in files."""
    return {field.alias or name: field for name, field in section.model_fields.items()}


def is_free_table(field: FieldInfo) -> bool:
    """True for a table with arbitrary keys (the options of a driver)."""
    return typing.get_origin(field.annotation) is dict


def takes_text_only(path: Sequence[str | int]) -> bool:
    """Whether the key at a path takes text and nothing else, such as a serial number."""
    field = locate_key(path).field
    return field is not None and field.annotation in (str, str | None)


@dataclass(frozen=True, slots=True)
class KeyLocation:
    """Result of following a path through the models.

    ``path`` is as in files, without the tags that a validation inserts; ``field`` the field there, ``None``
    if the path does not exist; ``existing`` the part that exists, with items of arrays and free tables;
    ``candidate_sections`` the sections that could contain the first missing key.
    """

    path: KeyPath
    field: FieldInfo | None
    existing: KeyPath
    candidate_sections: tuple[type[BaseModel], ...]


def locate_key(path: Sequence[str | int]) -> KeyLocation:
    """Follow a path from a file or a validation through the models."""
    sections: dict[str, type[BaseModel]] = {"": SystemConfig}
    field: FieldInfo | None = None
    plain: list[str | int] = []
    existing = 0
    missing_in: tuple[type[BaseModel], ...] | None = None
    for step in path:
        if missing_in is None and len(sections) > 1 and step in sections:
            sections = {"": sections[str(step)]}
            continue
        plain.append(step)
        if missing_in is not None:
            continue
        inner = next(
            (fields[str(step)] for fields in map(fields_of, sections.values()) if step in fields), None
        )
        if inner is not None:
            field, sections, existing = inner, sections_of(inner.annotation), existing + 1
        elif not sections and field is not None and (is_free_table(field) or isinstance(step, int)):
            missing_in, existing = (), existing + 1
        else:
            missing_in, field = tuple(sections.values()), None
    return KeyLocation(tuple(plain), field, tuple(plain[:existing]), missing_in or ())


def kinds_with_key(path: KeyPath) -> list[str]:
    """The kinds of a section with several kinds that have the last key of a path."""
    field = locate_key(path[:-1]).field
    variants = {} if field is None else sections_of(field.annotation)
    return [kind for kind, section in variants.items() if path[-1] in fields_of(section)]


@cache
def all_keys() -> tuple[str, ...]:
    """Every key of the configuration, without section names alone, as dotted text."""
    return tuple(dict.fromkeys(_leaves(SystemConfig, "")))


def _leaves(section: type[BaseModel], prefix: str) -> Iterator[str]:
    for name, field in fields_of(section).items():
        inner = sections_of(field.annotation)
        if not inner:
            yield prefix + name
        for one in inner.values():
            yield from _leaves(one, f"{prefix}{name}.")


def closest_key(path: Sequence[str | int]) -> str | None:
    """Suggestion for an unknown key: a similar neighbour, the same name elsewhere, or a similar path."""
    place = locate_key(path)
    path, depth = place.path, len(place.existing)
    neighbours = [name for holder in place.candidate_sections for name in fields_of(holder)]
    neighbour = closest_match(str(path[min(depth, len(path) - 1)]), neighbours)
    if neighbour is not None:
        return format_path((*place.existing, neighbour, *path[depth + 1 :]))
    elsewhere = [key for key in all_keys() if key.rpartition(".")[2] == str(path[-1])]
    # Prefer the least nested keys: usually one section name is missing.
    levels = min((key.count(".") for key in elsewhere), default=0)
    elsewhere = [key for key in elsewhere if key.count(".") == levels]
    return closest_match(format_path(path), elsewhere or all_keys()) or (elsewhere[0] if elsewhere else None)


def range_text(field: FieldInfo, item: int | None = None) -> str:
    """Allowed range of a number, or of item ``item`` of an array, as text: ``0 < x <= 2``; may be empty."""
    low = high = ""
    for rule in _rules(field, item):
        if isinstance(rule, Ge):
            low = f"{rule.ge:g} <= "
        elif isinstance(rule, Gt):
            low = f"{rule.gt:g} < "
        elif isinstance(rule, Le):
            high = f" <= {rule.le:g}"
        elif isinstance(rule, Lt):
            high = f" < {rule.lt:g}"
    return f"{low}x{high}" if low or high else ""


def _rules(field: FieldInfo, item: int | None) -> list[Any]:
    if item is None:
        return list(field.metadata)
    kinds = [kind for kind in typing.get_args(field.annotation) if kind is not Ellipsis]
    if not kinds:
        return []
    kind = kinds[min(item, len(kinds) - 1)]
    found: list[Any] = []
    for extra in getattr(kind, "__metadata__", ()):
        found += extra.metadata if isinstance(extra, FieldInfo) else [extra]
    return found
