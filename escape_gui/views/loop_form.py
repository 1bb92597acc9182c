"""Edited parameters of the loop: differences to the current ones, and validation. No widgets."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pydantic import ValidationError

from escape_hw.config.system import MAX_GAIN
from escape_hw.remote.requests import SetLoop
from escape_hw.remote.state import LoopState

#: Labels of the fields, in the order of the form.
FIELDS = {"matrix": "matrix", "gain": "gain", "leak": "leak", "dropped_modes": "dropped modes"}
#: Lowest and highest value of the numbers.
LIMITS = {"gain": (0.0, MAX_GAIN), "leak": (0.0, 1.0), "dropped_modes": (0, 10_000)}
#: Any client identifier will do to validate the values of a request.
_PLACEHOLDER_CLIENT = "00000000"


@dataclass(frozen=True, slots=True)
class LoopSettingsEdit:
    """Values of the form."""

    matrix: str
    gain: float
    leak: float
    dropped_modes: int

    def changed(self, loop: LoopState) -> dict[str, Any]:
        """Values that differ from those of the loop, by field."""
        values = {name: getattr(self, name) for name in FIELDS}
        return {
            name: value
            for name, value in values.items()
            if value != getattr(loop, name) and not (name == "matrix" and not value)
        }

    def describe_changes(self, loop: LoopState) -> str:
        """The changes, as in ``gain 0.425 → 0.5``."""
        changes = self.changed(loop)
        parts = (
            f"{FIELDS[name]} {_text(getattr(loop, name))} → {_text(new)}" for name, new in changes.items()
        )
        return ", ".join(parts) or "no changes"

    def describe(self) -> str:
        """All values, in words."""
        return (
            f"matrix '{self.matrix}', gain {self.gain:g}, leak {self.leak:g}, "
            f"{self.dropped_modes} dropped modes"
        )

    def validation_errors(self, loop: LoopState) -> tuple[str, ...]:
        """Reasons why the server would reject the values; empty if valid."""
        errors = []
        try:
            SetLoop(client=_PLACEHOLDER_CLIENT, **self.changed(loop))
        except ValidationError as error:
            errors += [_range_error(str(one["loc"][0]), one["msg"], self) for one in error.errors()]
        all_modes = loop.n_modes + loop.dropped_modes
        if loop.n_modes and self.dropped_modes >= all_modes:
            errors.append(f"dropped modes: {self.dropped_modes} of {all_modes} leaves none to control")
        return tuple(errors)


def _range_error(name: str, reason: str, edit: LoopSettingsEdit) -> str:
    """What is wrong with a value, with its limits."""
    if name not in LIMITS:
        return f"{FIELDS[name]}: {reason}"
    low, high = LIMITS[name]
    above = "above " if name == "gain" else ""
    return f"{FIELDS[name]} {getattr(edit, name):g} is out of range: {above}{low:g} to {high:g}"


def _text(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value) or "none"
