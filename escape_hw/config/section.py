"""Base class of configuration sections, and rules over several keys."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Annotated, Any, NamedTuple, TypeVar

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict
from pydantic_core import PydanticCustomError

from escape_hw.api.flips import FLIPS
from escape_hw.config.layouts import read_numbers, resolve_layout
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


def _resolve_order(order: str) -> str:
    kind, _, rest = order.partition(":")
    try:
        if kind == "table":
            return "numbers:" + ",".join(map(str, read_numbers(rest)))
        if kind == "numbers" and re.fullmatch(r"\d{1,5}(,\d{1,5})*", rest):
            return order
    except ValueError as error:
        raise PydanticCustomError("layout", "{text}", {"text": f"order {order[:40]!r}: {error}"}) from error
    if order not in FLIPS:
        text = f"order {order[:40]!r} is unknown; choose {ORDERS}"
        raise PydanticCustomError("layout", "{text}", {"text": text})
    return order


#: What a numbering of actuators may be, for messages.
ORDERS = f"{', '.join(map(repr, FLIPS))}, 'table:FILE' (text, .npy or .fits) or 'numbers:2,0,1'"
#: Numbering of the actuators in the hardware; the content of a file replaces the file's name.
OrderText = Annotated[str, AfterValidator(_resolve_order)]
