"""Arguments of procedures: what a client may say, checked against what the procedure offers."""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping, Sequence

from escape_hw.errors import ConfigError
from escape_hw.remote.state import Arguments, Parameter

Value = float | int | bool | str | None


def completed(offered: Sequence[Parameter], arguments: Mapping[str, Value]) -> Arguments:
    """Every argument with its value, defaults where nothing is said.

    Raises
    ------
    ConfigError
        Unknown, of the wrong kind or out of range; all that is wrong at once, with the way out.
    """
    known = {parameter.name: parameter for parameter in offered}
    wrong = [_unknown(name, known) for name in arguments if name not in known]
    values: Arguments = {}
    for name, parameter in known.items():
        value = arguments.get(name)
        if value is None:
            values[name] = parameter.default
            continue
        try:
            values[name] = _checked(parameter, value)
        except ConfigError as error:
            wrong.append(str(error))
    if wrong:
        raise ConfigError("; ".join(wrong))
    return values


def _unknown(name: str, known: Mapping[str, Parameter]) -> str:
    near = difflib.get_close_matches(name, known, 1)
    hint = f"did you mean '{near[0]}'?" if near else f"there are {', '.join(known) or 'none'}"
    return f"'{name}' is no argument of this procedure; {hint}"


def _checked(parameter: Parameter, value: Value) -> Value:
    name = parameter.name
    if parameter.kind == "bool":
        if not isinstance(value, bool):
            raise ConfigError(f"{name} is {value!r}; it must be true or false")
        return value
    if parameter.kind in ("int", "float"):
        return _number(parameter, value)
    if not isinstance(value, str):
        raise ConfigError(f"{name} is {value!r}; it must be text")
    if parameter.kind == "choice" and value not in parameter.choices:
        raise ConfigError(f"{name} is '{value}'; it is one of {', '.join(parameter.choices)}")
    return value


def _number(parameter: Parameter, value: Value) -> float | int:
    name, whole = parameter.name, parameter.kind == "int"
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ConfigError(f"{name} is {value!r}; it must be a number")
    if whole and value != int(value):
        raise ConfigError(f"{name} is {value!r}; it must be a whole number")
    low, high = parameter.low, parameter.high
    if (low is not None and value < low) or (high is not None and value > high):
        unit = f" {parameter.unit}" if parameter.unit else ""
        least = "" if low is None else f"at least {low:g}"
        most = "" if high is None else f"at most {high:g}"
        raise ConfigError(
            f"{name} is {value:g}; it must be {' and '.join(filter(None, (least, most)))}{unit}"
        )
    return int(value) if whole else float(value)
