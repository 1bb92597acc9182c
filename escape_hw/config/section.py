"""What every configuration section has in common."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Any, NamedTuple, TypeVar

from pydantic import BaseModel, BeforeValidator, ConfigDict
from pydantic_core import PydanticCustomError

#: Type of the errors that rules over several keys raise; the loader unpacks them.
RULE_ERROR = "rule"

T = TypeVar("T")


class Section(BaseModel):
    """A frozen table of the configuration; unknown keys and silent conversions are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class RuleViolation(NamedTuple):
    """A rule over several keys that is broken: the key to blame (dotted), its value, what to do."""

    key: str
    value: Any
    message: str


def raise_violations(violations: Iterable[RuleViolation]) -> None:
    """Raise one error that carries every broken rule; for ``model_validator(mode="after")``.

    Raises
    ------
    PydanticCustomError
        When there is any breach.
    """
    found = list(violations)
    if found:
        text = "; ".join(f"{b.key} = {b.value}: {b.message}" for b in found)
        raise PydanticCustomError(RULE_ERROR, "{text}", {"text": text, "breaches": found})


def _list_to_tuple(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


#: ``TomlArray[tuple[float, ...]]``: a TOML array that is kept as a tuple, so that sections stay frozen.
TomlArray = Annotated[T, BeforeValidator(_list_to_tuple)]
