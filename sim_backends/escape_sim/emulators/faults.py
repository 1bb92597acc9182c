"""Faults of a wire by script: what happens at the n-th command."""

from __future__ import annotations

from dataclasses import dataclass

from escape_hw.errors import ConfigError

#: Lost command; lost, late, doubled, cut reply; noise before it; hang-up; reset; no answer any more.
KINDS = ("lose", "drop", "late", "double", "truncate", "garbage", "close", "reset", "power", "stall")


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault.

    Parameters
    ----------
    kind
        One of :data:`KINDS`.
    at
        Number of the command, counted from 0 since the emulator started.
    """

    kind: str
    at: int


def parse(text: str) -> tuple[Fault, ...]:
    """``drop@12,late@30`` as faults.

    Raises
    ------
    ConfigError
        Not of that form.
    """
    faults = []
    for part in filter(None, text.split(",")):
        kind, _, at = part.strip().partition("@")
        if kind not in KINDS or not at.isdigit():
            raise ConfigError(f"fault {part!r}: write KIND@NUMBER, KIND one of {', '.join(KINDS)}")
        faults.append(Fault(kind, int(at)))
    return tuple(faults)


class HangUp(Exception):
    """The wire is to be cut now."""


class FaultyWire:
    """Passes replies on, or not.

    Parameters
    ----------
    faults
        What is to happen when.
    """

    def __init__(self, faults: tuple[Fault, ...] = ()) -> None:
        self._faults = {fault.at: fault.kind for fault in faults}
        self._held = b""
        self._count = 0
        self.stalled = False

    def take(self) -> str:
        """The fault of the next command; empty: none."""
        kind = self._faults.get(self._count, "")
        self._count += 1
        self.stalled = self.stalled or kind == "stall"
        return kind

    def passed(self, kind: str, reply: bytes) -> bytes:
        """What reaches the client of a reply."""
        if self.stalled or kind in ("drop", "lose"):
            return b""
        if kind == "late":
            self._held += reply
            return b""
        held, self._held = self._held, b""
        if kind == "double":
            reply += reply
        elif kind == "truncate":
            reply = reply[: len(reply) // 2]
        elif kind == "garbage":
            reply = b"\xb1\x00%$ 17=x\n" + reply
        return held + reply
