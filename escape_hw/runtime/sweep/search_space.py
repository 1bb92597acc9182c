"""Search space of a sweep: ranges and lists of values, by key."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from escape_hw.config.loader import parse_override
from escape_hw.errors import ConfigError

if TYPE_CHECKING:
    from optuna.distributions import BaseDistribution

#: Parameters of the loop; any other key is one of the configuration.
LOOP_KEYS = ("gain", "leak", "dropped_modes")
#: Delay of a simulated loop beyond the configured one, in frames.
DELAY_KEY = "delay"
_RANGE = re.compile(r"^(?P<low>[^:=,]+):(?P<high>[^:=,]+?)(?P<log>:log)?$")


@dataclass(frozen=True, slots=True)
class Range:
    """A parameter between two limits, both included: uniform, uniform in its logarithm, or an integer."""

    key: str
    low: float
    high: float
    log: bool = False
    integer: bool = False

    def at(self, share: float) -> float | int:
        """The value at a share, 0 to 1, of the way from the lower to the upper limit."""
        if self.integer:
            return min(int(self.low + share * (self.high - self.low + 1)), int(self.high))
        if self.log:
            return float(self.low * (self.high / self.low) ** share)
        return float(self.low + share * (self.high - self.low))

    def distribution(self) -> BaseDistribution:
        """The range for Optuna."""
        from optuna.distributions import FloatDistribution, IntDistribution

        if self.integer:
            return IntDistribution(int(self.low), int(self.high))
        return FloatDistribution(self.low, self.high, log=self.log)

    def to_text(self) -> str:
        """As :func:`parse_parameter` reads it."""
        return f"{self.key}={self.low:.12g}:{self.high:.12g}{':log' if self.log else ''}"


@dataclass(frozen=True, slots=True)
class Choices:
    """A parameter with a few values: numbers, words or truth values."""

    key: str
    values: tuple[Any, ...]

    def at(self, share: float) -> Any:
        """The value at a share, 0 to 1, of the list."""
        return self.values[min(int(share * len(self.values)), len(self.values) - 1)]

    def distribution(self) -> BaseDistribution:
        """The choices for Optuna."""
        from optuna.distributions import CategoricalDistribution

        return CategoricalDistribution(self.values)

    def to_text(self) -> str:
        """As :func:`parse_parameter` reads it."""
        return f"{self.key}={','.join(map(format_value, self.values))}"


Parameter = Range | Choices


def parse_parameter(text: str) -> Parameter:
    """Read ``KEY=LOW:HIGH``, ``KEY=LOW:HIGH:log`` or ``KEY=a,b,c``.

    Raises
    ------
    ConfigError
        It has neither form, the limits are not in order, or a logarithmic range begins at zero.
    """
    key, equals, values = (part.strip() for part in text.partition("="))
    if not equals or not key or not values:
        raise ConfigError(f"--vary {text!r} is not of the form KEY=LOW:HIGH, KEY=LOW:HIGH:log or KEY=a,b,c")
    found = _RANGE.match(values)
    if found is None:
        return Choices(key, tuple(_parse_value(key, one) for one in values.split(",")))
    low, high = (_parse_value(key, found[name]) for name in ("low", "high"))
    if any(isinstance(limit, bool) or not isinstance(limit, int | float) for limit in (low, high)):
        raise ConfigError(f"{key}={values}: the limits must be numbers")
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        raise ConfigError(f"{key}={values}: the lower limit must be below the upper one")
    if found["log"] and low <= 0:
        raise ConfigError(f"{key}={values}: a logarithmic range needs a lower limit above zero")
    integer = isinstance(low, int) and isinstance(high, int) and (key == "dropped_modes" or "." in key)
    if found["log"] or not integer:
        return Range(key, float(low), float(high), bool(found["log"]))
    return Range(key, low, high, integer=True)


def _parse_value(key: str, text: str) -> Any:
    return parse_override(f"{key}={text.strip()}").value


def format_value(value: Any) -> str:
    """A value as an override of the configuration takes it."""
    return str(value).lower() if isinstance(value, bool) else str(value)


def default_space(n_modes: int, parameters: Sequence[Parameter]) -> tuple[Parameter, ...]:
    """The default ranges of the loop's parameters, replaced and extended by those given.

    The gain spans a factor of thirty, because the matrix of a pyramid without its optical gains may be
    wrong in scale by a factor of several; at most a third of the modes is dropped.

    Raises
    ------
    ConfigError
        A key is given twice.
    """
    defaults: tuple[Parameter, ...] = (
        Range("gain", 0.05, 1.5, log=True),
        Range("leak", 1e-3, 0.1, log=True),
        Range("dropped_modes", 0, n_modes // 3, integer=True),
    )
    replacements = {one.key: one for one in parameters}
    if len(replacements) < len(parameters):
        raise ConfigError(f"{parameters[-1].key}: varied twice")
    known = [replacements.pop(one.key, one) for one in defaults]
    return (*known, *replacements.values())


def config_overrides(values: dict[str, Any]) -> tuple[str, ...]:
    """Overrides of the configuration for the parameters that are keys of it."""
    return tuple(f"{key}={format_value(value)}" for key, value in values.items() if "." in key)
