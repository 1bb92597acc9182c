"""What keys the configuration has: walks the models, for messages and for overrides."""

from __future__ import annotations

import difflib
import types
import typing
from collections.abc import Iterable, Iterator, Sequence
from functools import cache
from typing import Any

from annotated_types import Ge, Gt, Le, Lt
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from escape_hw.config.models import SystemConfig

Path = tuple[str | int, ...]


def dotted(path: Sequence[str | int]) -> str:
    """A path as text, ``devices.screen.screens_r0_m[2]``."""
    text = ""
    for step in path:
        text += f"[{step}]" if isinstance(step, int) else f".{step}" if text else step
    return text


def section_of(annotation: Any) -> type[BaseModel] | None:
    """The model that an annotation ``Model`` or ``Model | None`` stands for, if any."""
    options = typing.get_args(annotation) if _is_union(annotation) else (annotation,)
    for option in options:
        if isinstance(option, type) and issubclass(option, BaseModel):
            return option
    return None


def fields_of(section: type[BaseModel]) -> dict[str, FieldInfo]:
    """The keys of a section by the names that files use."""
    return {field.alias or name: field for name, field in section.model_fields.items()}


def is_free_table(field: FieldInfo) -> bool:
    """True for a table whose keys are not ours to know (a driver's options)."""
    return typing.get_origin(field.annotation) is dict


def field_at(path: Sequence[str | int]) -> tuple[FieldInfo | None, Path]:
    """The field that a path leads to, and the part of the path that exists.

    Returns
    -------
    field : FieldInfo or None
        ``None`` when the path leads nowhere.
    known : tuple
        The path up to where it leaves the model; an item of an array or of a free table counts.
    """
    section: type[BaseModel] | None = SystemConfig
    field: FieldInfo | None = None
    for depth, step in enumerate(path):
        if section is None:
            free = field is not None and (is_free_table(field) or isinstance(step, int))
            return (field, tuple(path[: depth + 1])) if free else (None, tuple(path[:depth]))
        field = fields_of(section).get(str(step))
        if field is None:
            return None, tuple(path[:depth])
        section = section_of(field.annotation)
    return field, tuple(path)


@cache
def all_keys() -> tuple[str, ...]:
    """Every key of the configuration, sections left out, as dotted text."""
    return tuple(_leaves(SystemConfig, ""))


def _leaves(section: type[BaseModel], prefix: str) -> Iterator[str]:
    for name, field in fields_of(section).items():
        inner = section_of(field.annotation)
        if inner is None:
            yield prefix + name
        else:
            yield from _leaves(inner, f"{prefix}{name}.")


def nearest(word: str, choices: Iterable[str]) -> str | None:
    """The choice that looks most like a word, or ``None`` when none comes close."""
    found = difflib.get_close_matches(word, list(choices), n=1, cutoff=0.6)
    return found[0] if found else None


def nearest_key(path: Sequence[str | int]) -> str | None:
    """The key somebody probably meant: a neighbour, the same name elsewhere, or a similar path."""
    _, known = field_at(path)
    wrong = str(path[len(known)]) if len(known) < len(path) else str(path[-1])
    holder: type[BaseModel] | None = None if known else SystemConfig
    if known:
        field, _ = field_at(known)
        holder = None if field is None else section_of(field.annotation)
    if holder is not None:
        neighbour = nearest(wrong, fields_of(holder))
        if neighbour is not None:
            return dotted((*known, neighbour, *path[len(known) + 1 :]))
    elsewhere = [key for key in all_keys() if key.rpartition(".")[2] == str(path[-1])]
    return nearest(dotted(path), elsewhere or all_keys()) or (elsewhere[0] if elsewhere else None)


def range_text(field: FieldInfo, item: int | None = None) -> str:
    """The allowed range of a number as text, ``0 < x <= 2``; empty when there is none.

    Parameters
    ----------
    field
        The field.
    item
        For an array: the number of the item asked about.
    """
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


def _is_union(annotation: Any) -> bool:
    return isinstance(annotation, types.UnionType) or typing.get_origin(annotation) is typing.Union
