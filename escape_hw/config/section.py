"""Base class of configuration sections, and rules over several keys."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Any, NamedTuple, TypeVar

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict
from pydantic_core import PydanticCustomError

from escape_hw.config.layouts import resolve_layout
from escape_hw.deprecation import warn_renamed

#: Error type of violated rules over several keys.
RULE_ERROR = "rule"

T = TypeVar("T")


class Section(BaseModel):
    """A frozen table of the configuration. Unknown keys and type conversions are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class RuleViolation(NamedTuple):
    """A violated rule over several keys: the key to report (dotted), its value, the remedy."""

    key: str
    value: Any
    message: str


def raise_violations(violations: Iterable[RuleViolation]) -> None:
    """Raise one error with all violations, if there are any; for ``model_validator(mode="after")``.

    Raises
    ------
    PydanticCustomError
        At least one rule is violated.
    """
    found = list(violations)
    if found:
        text = "; ".join(f"{v.key} = {v.value}: {v.message}" for v in found)
        raise PydanticCustomError(RULE_ERROR, "{text}", {"text": text, "violations": found})


def _list_to_tuple(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


#: ``TomlArray[tuple[float, ...]]``: a TOML array stored as a tuple, which keeps sections immutable.
TomlArray = Annotated[T, BeforeValidator(_list_to_tuple)]


#: Layouts that version 0.3.0 removes, and what is said about them.
_RETIRED = {
    "rings-336": "layout 'rings-336' was a guess of the MMT's mirror and goes in version 0.3.0; 'maps-336' "
    "has the published positions, and matrices of the other layout must be measured again"
}


def _resolve_layout(layout: str) -> str:
    if layout in _RETIRED:
        warn_renamed(_RETIRED[layout])
    try:
        return resolve_layout(layout)
    except ValueError as error:
        raise PydanticCustomError("layout", "{text}", {"text": str(error)}) from error


#: A layout, see :mod:`escape_hw.config.layouts`; the content of a file replaces the file's name.
LayoutText = Annotated[str, AfterValidator(_resolve_layout)]
