"""Options of the emulators, scripts of their faults, and the option words of version 0.1.0."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from typing import ClassVar, Self, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from escape_hw.api.emulator import EmulatorRequest
from escape_hw.errors import ConfigError

F = TypeVar("F")


def current_word(word: str, renamed: Mapping[str, str]) -> str:
    """Replace a word of version 0.1.0 by the present one and say so on standard error."""
    if word not in renamed:
        return word
    print(f"deprecated: {word!r} is now {renamed[word]!r}; the old word will be removed", file=sys.stderr)
    return renamed[word]


def parse_fault_script(script: str, parse_fault: Callable[[str], F]) -> dict[int, F]:
    """Faults of a script such as ``close@3,truncate@40`` by the number of the request, counted from 0.

    Raises
    ------
    ConfigError
        The script has another form, or ``parse_fault`` does not know a fault.
    """
    faults = {}
    for part in filter(None, script.split(",")):
        fault, _, number = part.strip().partition("@")
        if not number.isdigit():
            raise ConfigError(f"fault {part!r}: write KIND@NUMBER, where NUMBER counts requests from 0")
        faults[int(number)] = parse_fault(fault)
    return faults


class EmulatorOptions(BaseModel):
    """The options of an emulator, converted from text; ``RENAMED`` are the names of version 0.1.0."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    RENAMED: ClassVar[Mapping[str, str]] = {}

    @classmethod
    def from_request(cls, request: EmulatorRequest) -> Self:
        """The options of a request; raises ``ConfigError`` if one is unknown or has no valid value."""
        options = {current_word(key, cls.RENAMED): value for key, value in request.options.items()}
        try:
            return cls.model_validate(options)
        except ValidationError as error:
            detail = error.errors(include_url=False)[0]
            key = detail["loc"][0]
            if detail["type"] == "extra_forbidden":
                known = ", ".join(field.alias or name for name, field in cls.model_fields.items())
                raise ConfigError(f"--option {key}: unknown; this emulator has {known}") from None
            message = detail["msg"].replace("Input should", "must")
            raise ConfigError(f"--option {key}={detail['input']}: {message}") from None
