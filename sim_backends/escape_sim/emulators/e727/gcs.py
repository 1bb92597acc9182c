"""General Command Set 2.0 as a controller reads and writes it: framing, arguments, replies, errors.

Facts from the manual of the E-727 (E727T0005): lines end with a line feed; a few commands are a single
byte without one; a line has at most 32 arguments; in replies of several lines each line but the last ends
with a blank before the line feed.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

#: Commands of a single byte, and their written form: moving, ready, macro, generators, stop all.
ONE_BYTE = {"\x05": "#5", "\x07": "#7", "\x08": "#8", "\x09": "#9", "\x18": "#24"}
#: Largest number of arguments and of bytes of a line.
MAX_ARGUMENTS, MAX_LINE = 32, 4096
ENCODING = "cp1252"

ERRORS = {
    1: "syntax", 2: "unknown command", 3: "line too long", 5: "servo off or axis unreferenced",
    7: "position out of range", 8: "velocity out of range", 10: "stopped by command", 15: "invalid axis",
    17: "parameter out of range", 22: "axis named twice", 23: "illegal axis", 24: "wrong number of arguments",
    25: "not a number", 26: "missing argument", 53: "parameter cannot be set", 54: "unknown parameter",
    56: "wrong password", 57: "record table out of range", 58: "record source out of range",
    59: "record option out of range", 60: "command level too low", 61: "auto-zero running",
    63: "initialising", 64: "read only", 66: "voltage out of limits", 67: "wave too large",
    72: "analogue target active", 73: "wave generator active", 75: "no wave table selected",
    79: "servo is on", 98: "auto-zero failed", 400: "wave table out of range", 401: "wave table undefined",
    402: "wave type unknown", 403: "wave length", 404: "number of wave parameters",
    405: "wave parameter out of range", 406: "bit of WGO not supported",
}  # fmt: skip


class GcsCommandError(Exception):
    """A command is refused; ``number`` is returned by ``ERR?``."""

    def __init__(self, number: int) -> None:
        super().__init__(f"error {number} ({ERRORS.get(number, 'unknown')})")
        self.number = number


class CommandFramer:
    """Splits received bytes into commands, however they are fragmented."""

    def __init__(self) -> None:
        self._line = bytearray()
        self._overflowed = False

    def feed(self, data: bytes) -> Iterator[str | None]:
        """Commands that ``data`` completes; None for a line that is too long."""
        for byte in data:
            if byte == 0x0A:
                line, self._line = self._line, bytearray()
                overflowed, self._overflowed = self._overflowed, False
                if overflowed:
                    yield None
                elif text := line.decode(ENCODING, "replace").strip():
                    yield text
            elif chr(byte) in ONE_BYTE:
                yield chr(byte)
            elif len(self._line) >= MAX_LINE:
                self._overflowed = True
            elif byte:
                self._line.append(byte)

    def clear(self) -> None:
        """Discard an unfinished line."""
        self._line.clear()
        self._overflowed = False


def parse_number(text: str) -> float:
    """Parse a finite number; raises error 25 otherwise."""
    try:
        value = float(text)
    except ValueError:
        raise GcsCommandError(25) from None
    if not math.isfinite(value):
        raise GcsCommandError(25)
    return value


def parse_integer(text: str) -> int:
    """Parse an integer, decimal or hexadecimal; raises error 25 otherwise."""
    try:
        return int(text, 0)
    except ValueError:
        value = parse_number(text)
        if value != int(value):
            raise GcsCommandError(25) from None
        return int(value)


def group_arguments(args: Sequence[str], size: int) -> list[Sequence[str]]:
    """Split arguments into groups of ``size``, at least one; raises error 26 or 24 otherwise."""
    if not args:
        raise GcsCommandError(26)
    if len(args) % size:
        raise GcsCommandError(24)
    return [args[k : k + size] for k in range(0, len(args), size)]


def value_text(value: float | int | str) -> str:
    """Format a value as the controller does."""
    return f"{value:.9e}" if isinstance(value, float) else str(value)


def format_lines(rows: Sequence[str]) -> str:
    """Format a reply of one or more lines."""
    return " \n".join(rows) + "\n"


def format_items(values: Mapping[str, float | int | str]) -> str:
    """Format a reply of the form ``1=0.000000000e+00``."""
    return format_lines([f"{key}={value_text(value)}" for key, value in values.items()])


def format_array(columns: Mapping[str, NDArray[np.float64]], sample_s: float) -> str:
    """Format an array as ``DRR?`` and ``GWD?`` do: a header, then one row per point."""
    table = np.stack(list(columns.values()), axis=1)
    header = ["# TYPE = 1", "# SEPARATOR = 32", f"# DIM = {table.shape[1]}"]
    header += [f"# SAMPLE_TIME = {sample_s:.6f}", f"# NDATA = {table.shape[0]}"]
    header += [f"# NAME{k} = {name}" for k, name in enumerate(columns)]
    rows = [" ".join(f"{value:.6f}" for value in row) for row in table]
    return format_lines([*header, "# END_HEADER", *rows])
