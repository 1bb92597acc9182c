"""Turns what is wrong with a configuration into lines that an operator can act on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from pydantic import ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from escape_hw.config import outline
from escape_hw.config.section import RULE_ERROR
from escape_hw.config.toml_text import format_value

Path = outline.Path

#: Longest value that is quoted in a message.
_LONGEST = 60

#: What pydantic's kinds of error are called here.
_WORDS = {
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
class Problem:
    """One thing that is wrong: which key, its value as text (may be empty), what and what to do."""

    path: Path
    value: str
    message: str

    def line(self, where: str) -> str:
        """The problem on one line, after the place it was found at."""
        value = f" {self.value}" if self.value else ""
        return f"{where}  {outline.dotted(self.path)}:{value}  {self.message}"


def unknown_key(path: Sequence[str | int], value: Any) -> Problem:
    """A key that the configuration does not have."""
    plain = outline.place_of(path).path
    if outline.place_of(plain).known == plain:
        # Another kind of this section has it.
        others = ", ".join(f"'{kind}'" for kind in outline.kinds_with(plain))
        return Problem(plain, show(value), f"is a key of kind = {others} only")
    meant = outline.nearest_key(path)
    hint = f" (did you mean '{meant}'?)" if meant else ""
    return Problem(plain, show(value), f"unknown key{hint}")


def problems_of(error: ValidationError) -> list[Problem]:
    """Every problem that a validation found, without repetitions, in the order of the models."""
    found: dict[tuple[Path, str], Problem] = {}
    for detail in error.errors(include_url=False):
        for problem in _translate(detail):
            found.setdefault((problem.path, problem.message), problem)
    return list(found.values())


def show(value: Any) -> str:
    """A value as TOML text, shortened when it is long."""
    try:
        text = format_value(value)
    except TypeError:
        text = str(value)
    return text if len(text) <= _LONGEST else text[: _LONGEST - 3] + "..."


def _translate(detail: ErrorDetails) -> list[Problem]:
    kind, value = detail["type"], detail["input"]
    place = outline.place_of(detail["loc"])
    path, field, known = place.path, place.field, place.known
    if kind == RULE_ERROR:
        return [
            Problem((*path, *breach.key.split(".")), show(breach.value), breach.message)
            for breach in detail["ctx"]["breaches"]
        ]
    if kind == "extra_forbidden":
        return [unknown_key(detail["loc"], value)]
    if kind == "union_tag_invalid":
        return [_wrong_kind((*path, "kind"), value, field)]
    if field is None:
        return [Problem(path, show(value), _plain(detail))]
    if outline.is_free_table(field) and kind != "dict_type":
        return [Problem(known, show(value), "must be text, a number, true or false")]
    item = known[-1] if isinstance(known[-1], int) else None
    allowed = outline.range_text(field, item)
    hints = [f"allowed range {allowed}"] if allowed else []
    if kind == "missing":
        if item is not None:
            return [
                Problem(known[:-1], show(list(value)), f"has too few items; expected: {field.description}")
            ]
        hints.insert(0, field.description or "")
        return [Problem(path, "", f"is missing ({'; '.join(hints)})")]
    if kind == "literal_error":
        return [Problem(path, show(value), _wrong_choice(detail))]
    if kind == "string_pattern_mismatch":
        return [Problem(path, show(value), f"is not allowed; expected: {field.description}")]
    message = _plain(detail)
    return [Problem(known, show(value), message + (f" ({'; '.join(hints)})" if hints else ""))]


def _plain(detail: ErrorDetails) -> str:
    return _WORDS.get(detail["type"], detail["msg"][:1].lower() + detail["msg"][1:])


def _wrong_kind(path: Path, table: Any, field: FieldInfo | None) -> Problem:
    kinds = [] if field is None else list(outline.sections_of(field.annotation))
    value = table["kind"]
    meant = outline.nearest(str(value), kinds)
    hint = f" (did you mean '{meant}'?)" if meant else ""
    return Problem(path, show(value), f"must be {' or '.join(map(repr, kinds))}{hint}")


def _wrong_choice(detail: ErrorDetails) -> str:
    expected = detail["ctx"]["expected"]
    choices = [choice.strip("'") for choice in expected.replace(" or ", ", ").split(", ")]
    meant = outline.nearest(str(detail["input"]), choices)
    return f"must be {expected}" + (f" (did you mean '{meant}'?)" if meant else "")
