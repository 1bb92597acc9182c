"""Base class of configuration sections, and rules over several keys."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Any, NamedTuple, TypeVar

from pydantic import BaseModel, BeforeValidator, ConfigDict
from pydantic_core import PydanticCustomError

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
