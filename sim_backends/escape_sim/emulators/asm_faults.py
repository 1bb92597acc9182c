"""What goes wrong on the emulated adaptive secondary, by script."""

from __future__ import annotations

from dataclasses import dataclass

from escape_hw.errors import ConfigError

#: What may happen at a request, and whether it takes a value.
KINDS = {
    # Before the request is looked at.
    "close": False, "reset": False, "silent": False,
    # To the answer of a request that was carried out.
    "delay": True, "half": False, "crc": False, "stale": False, "double": False, "garbage": False,
    # To the mirror; calm ends over-currents and blindness.
    "skip": False, "dust": True, "stuck": True, "overcurrent": True, "watchdog": False, "trip": False,
    "calm": False,
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault: what, with which value (a number of an actuator, seconds)."""

    kind: str
    value: float = 0.0

    @classmethod
    def of(cls, words: str) -> Fault:
        """``dust:17`` or ``reset`` as a fault.

        Raises
        ------
        ConfigError
            Not of that form.
        """
        kind, colon, value = words.strip().partition(":")
        if kind not in KINDS or bool(colon) != KINDS[kind]:
            forms = ", ".join(f"{name}:VALUE" if takes else name for name, takes in KINDS.items())
            raise ConfigError(f"fault {words!r}: write one of {forms}")
        try:
            return cls(kind, float(value or 0))
        except ValueError as error:
            raise ConfigError(f"fault {words!r}: {value!r} is no number") from error


def parse(script: str) -> dict[int, Fault]:
    """``skip@3,dust:17@40`` as faults by the number of the owner's request, counted from 0.

    Raises
    ------
    ConfigError
        Not of that form.
    """
    faults: dict[int, Fault] = {}
    for part in filter(None, script.split(",")):
        words, _, at = part.partition("@")
        if not at.isdigit():
            raise ConfigError(f"fault {part!r}: write KIND@NUMBER, NUMBER that of the request")
        faults[int(at)] = Fault.of(words)
    return faults
