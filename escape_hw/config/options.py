"""Settings of a device that is used alone, and of a driver: checked as sections of a system file are."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict
from typing import Any, TypeVar

import numpy as np
from pydantic import ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from escape_hw.config.devices import LimitsConfig
from escape_hw.config.key_tree import fields_of, format_path, range_text, sections_of
from escape_hw.config.section import RULE_ERROR, Section
from escape_hw.errors import ConfigError
from escape_hw.safety.limits import CAUTIOUS_LIMITS, MirrorLimits
from escape_hw.suggestions import closest_match

Options = TypeVar("Options", bound=Section)


def parse_options(
    kind: type[Options], where: str, options: Mapping[str, Any], also: Iterable[str] = ()
) -> Options:
    """Settings as a section.

    Parameters
    ----------
    kind
        Class of the section.
    where
        Begins the names of settings in messages: a device, or a table of a system file.
    options
        The settings by their names; numbers and arrays may be those of numpy, and texts may be paths.
    also
        Names that are settings too, but not of this section; for suggestions.

    Raises
    ------
    ConfigError
        Every unknown option (with the nearest one) and every wrong value, at once.
    """
    try:
        return kind.model_validate(_plain(options))
    except ValidationError as error:
        details = error.errors(include_url=False)
        raise ConfigError(
            "\n".join(line for detail in details for line in _describe(kind, where, detail, also))
        ) from None


def parse_limits(device: str, limits: MirrorLimits | Mapping[str, Any]) -> MirrorLimits:
    """Limits of a mirror; a table has those that differ from the cautious ones.

    Raises
    ------
    ConfigError
        A limit is unknown or out of range.
    """
    if isinstance(limits, MirrorLimits):
        return limits
    if not isinstance(limits, Mapping):
        raise ConfigError(
            f"{device}.limits: {limits!r}  must be MirrorLimits or a table such as {{'max_stroke': 0.3}}, on "
            "the command line --set limits.max_stroke=0.3"
        )
    return parse_options(LimitsConfig, f"{device}.limits", {**asdict(CAUTIOUS_LIMITS), **limits}).to_limits()


def _plain(value: Any) -> Any:
    """A value with NumPy arrays and scalars converted to plain Python ones, and paths to text."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if isinstance(value, Mapping):
        return {key: _plain(inner) for key, inner in value.items()}
    return [_plain(inner) for inner in value] if isinstance(value, list | tuple) else value


def _describe(kind: type[Section], where: str, detail: ErrorDetails, also: Iterable[str]) -> Iterator[str]:
    """The lines of one error of a validation."""
    path = (where, *detail["loc"])
    if detail["type"] == "missing" and isinstance(path[-1], int):
        yield f"{format_path(path[:-1])}: {detail['input']!r}  has too few items"
        return
    place = format_path(path)
    if detail["type"] == RULE_ERROR:
        for key, value, message in detail["ctx"]["violations"]:
            yield f"{place}.{key}: {value!r}  {message}"
        return
    holder, field = _follow(kind, detail["loc"])
    if field is None:
        known = list(dict.fromkeys([*(also if holder is kind else ()), *fields_of(holder)]))
        near = closest_match(str(detail["loc"][-1]), known)
        hint = f"did you mean '{near}'? " if near else ""
        yield f"{place}: unknown option ({hint}there are: {', '.join(known)})"
        return
    item = detail["loc"][-1]
    allowed = range_text(field, item if isinstance(item, int) else None)
    outside = allowed and detail["type"].startswith(("greater_than", "less_than"))
    message = "is out of range" if outside else detail["msg"].replace("Input should be", "must be")
    yield f"{place}: {detail['input']!r}  {message}{f' (allowed range {allowed})' if allowed else ''}"


def _follow(kind: type[Section], path: Iterable[str | int]) -> tuple[type[Section], FieldInfo | None]:
    """The section that holds the last key of a path, and its field; no field if there is none."""
    holder, field = kind, None
    for step in path:
        if isinstance(step, int):
            continue
        inner = sections_of(field.annotation).get("") if field is not None else None
        if inner is not None and issubclass(inner, Section):
            holder = inner
        field = fields_of(holder).get(step)
        if field is None:
            break
    return holder, field
