"""PI's General Command Set 2.0 as text.

Formats commands, parses replies, maps error numbers; no input or output.

Rules from the manual of the E-727 (E727T0005): a command is a mnemonic and at most 32 arguments, ended by a
line feed. Every line of a reply but the last ends with a blank before the line feed. Values come as
``1=0.000000000e+00``, arrays behind a header of ``# KEY = value`` that ends with ``# END_HEADER``. USB pads
with NUL.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from escape_hw.errors import DeviceError

_SERVO_HINT = "open the device anew, which switches the servos on in the right order"
_AXES_HINT = "compare stage.axes with the controller's axes (SAI?, CST?)"
_RANGE_HINT = "lower the radius or the centre; the controller's own limits are TMN? and TMX?"
_DRIVER_DEFECT = "this is a defect of the driver or a firmware that differs; see the bench checklist"
_ERRORS: dict[int, tuple[str, str]] = {
    1: ("syntax error", _DRIVER_DEFECT),
    2: ("unknown command", _DRIVER_DEFECT),
    3: ("line too long", _DRIVER_DEFECT),
    5: ("the servo is off, or the axis has no reference", _SERVO_HINT),
    7: ("position out of range", _RANGE_HINT),
    8: ("velocity out of range", _DRIVER_DEFECT),
    10: (
        "stopped by a stop command",
        "find what stopped it (another program, the front panel), then start again",
    ),
    15: ("invalid axis", _AXES_HINT),
    17: ("parameter out of range", _DRIVER_DEFECT),
    22: ("axis named twice", _AXES_HINT),
    23: ("illegal axis", _AXES_HINT),
    24: ("wrong number of arguments", _DRIVER_DEFECT),
    25: ("not a number", _DRIVER_DEFECT),
    26: ("missing argument", _DRIVER_DEFECT),
    53: ("this parameter cannot be set", _DRIVER_DEFECT),
    54: ("unknown parameter", _DRIVER_DEFECT),
    56: ("wrong password", _DRIVER_DEFECT),
    57: ("record table out of range", _DRIVER_DEFECT),
    58: ("record source out of range", _AXES_HINT),
    59: ("record option out of range", _DRIVER_DEFECT),
    60: ("protected parameter: command level too low", _DRIVER_DEFECT),
    61: ("auto-zero is running", "wait until it has ended (about a minute)"),
    63: ("the controller is initialising", "wait a few seconds and open again"),
    64: ("read only", _DRIVER_DEFECT),
    66: ("voltage out of limits", "see stage.auto_zero_v"),
    67: ("not enough memory for the wave", "lower stage.max_points"),
    72: ("an analogue input drives the axis", "take the analogue input off the axis (parameter 0x06000500)"),
    73: ("a wave generator drives the axis", "park first: escape modulator stop"),
    75: ("no wave table is selected", _DRIVER_DEFECT),
    79: ("the servo is on", _SERVO_HINT),
    98: (
        "auto-zero failed",
        "is the platform free to move, the cable of the head plugged in, the load not too heavy?",
    ),
    400: ("wave table out of range", _DRIVER_DEFECT),
    401: ("wave table undefined", _DRIVER_DEFECT),
    402: ("unknown wave type", _DRIVER_DEFECT),
    403: ("wrong length of a wave", _DRIVER_DEFECT),
    404: ("wrong number of wave parameters", _DRIVER_DEFECT),
    405: ("wave parameter out of range", _RANGE_HINT),
    406: ("bit of WGO not supported", _DRIVER_DEFECT),
}


class GcsError(DeviceError):
    """The controller refused a command; ``number`` is its error."""

    def __init__(self, device: str, number: int, command: str) -> None:
        text, remedy = _ERRORS.get(number, ("unknown error number", "see the controller's manual"))
        super().__init__(device, f"refused '{command}': error {number}, {text}; {remedy}")
        self.number, self._command = number, command

    def __reduce__(self) -> tuple[object, ...]:
        return GcsError, (self.device, self.number, self._command)


ENCODING = "cp1252"
#: Arguments of a line, and bytes of a reply, at most.
MAX_ARGUMENTS, MAX_REPLY = 32, 8 << 20


class MalformedReply(Exception):
    """A reply that does not match the question: link and controller are out of step.

    Raised by every parsing function of this module.
    """


def format_command(mnemonic: str, *arguments: str | float) -> bytes:
    """A command as it goes over the wire.

    Raises
    ------
    ValueError
        More than 32 arguments, a number that is not finite, or text that would be two commands.
    """
    words = [mnemonic, *map(_format_argument, arguments)]
    if len(arguments) > MAX_ARGUMENTS:
        raise ValueError(f"{mnemonic} with {len(arguments)} arguments; a line takes {MAX_ARGUMENTS}")
    if not all(word and word.isascii() and word.isprintable() and " " not in word for word in words):
        raise ValueError(
            f"{words!r} cannot be sent: an argument is empty or holds a blank or control character"
        )
    return " ".join(words).encode("ascii") + b"\n"


def _format_argument(argument: str | float) -> str:
    if isinstance(argument, str):
        return argument
    if not math.isfinite(argument):
        raise ValueError(f"{argument} cannot be sent; only finite numbers can")
    return str(argument) if isinstance(argument, int) else f"{argument:.10g}"


class ReplyReader:
    """Puts replies together from bytes, however they are split up."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._searched = 0

    @property
    def pending(self) -> int:
        """Bytes of an incomplete or unread reply."""
        return len(self._buffer)

    def feed(self, data: bytes) -> None:
        """Add what arrived; raises :class:`MalformedReply` without an end."""
        self._buffer += data.replace(b"\0", b"")
        if len(self._buffer) > MAX_REPLY:
            size = len(self._buffer)
            self.clear()
            raise MalformedReply(f"{size} bytes without an end")

    def next_reply(self) -> list[str] | None:
        """The lines of the first complete reply, without their ends; ``None`` while it is incomplete."""
        while (end := self._buffer.find(b"\n", self._searched)) >= 0:
            self._searched = end + 1
            if end == 0 or self._buffer[end - 1 : end] != b" ":
                reply = self._buffer[:end].decode(ENCODING, "replace")
                del self._buffer[: end + 1]
                self._searched = 0
                return [text.removesuffix("\r").removesuffix(" ") for text in reply.split("\n")]
        self._searched = len(self._buffer)
        return None

    def clear(self) -> None:
        """Forget everything."""
        self._buffer.clear()
        self._searched = 0


def parse_single_line(reply: Sequence[str]) -> str:
    """The only line of a reply."""
    if len(reply) != 1:
        raise MalformedReply(f"{len(reply)} lines where one was due: {reply[0][:40]!r} ...")
    return reply[0]


def parse_float(text: str) -> float:
    """A finite number."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise MalformedReply(f"{text[:40]!r} where a number was due")
    return value


def parse_int(text: str, base: int = 10) -> int:
    """A whole number, also with a prefix when ``base`` is 0."""
    try:
        return int(text, base)
    except ValueError:
        raise MalformedReply(f"{text[:40]!r} where a whole number was due") from None


def parse_single_int(reply: Sequence[str]) -> int:
    """A reply of one whole number."""
    return parse_int(parse_single_line(reply))


def values(reply: Sequence[str], keys: Sequence[str]) -> list[str]:
    """The values of lines ``KEY=value`` that must name just these keys, in this order."""
    pairs = [text.partition("=") for text in reply]
    found = [key.strip() for key, equals, _ in pairs if equals]
    if found != list(keys):
        raise MalformedReply(f"{' / '.join(reply)[:80]!r} where values of {', '.join(keys)} were due")
    return [value.strip() for _, _, value in pairs]


def parse_floats(reply: Sequence[str], keys: Sequence[str]) -> list[float]:
    """As :func:`values`, finite numbers."""
    return [parse_float(text) for text in values(reply, keys)]


def array(reply: Sequence[str], columns: int, rows: int) -> NDArray[np.float64]:
    """The numbers ``(rows, columns)`` of a reply to ``DRR?`` or ``GWD?``."""
    header = [k for k, text in enumerate(reply) if text.strip() == "# END_HEADER"]
    if len(header) != 1 or not all(text.startswith("#") for text in reply[: header[0]]):
        raise MalformedReply(f"{reply[0][:40]!r} ... where an array with a header was due")
    body = reply[header[0] + 1 :]
    split = [text.split() for text in body]
    if len(body) != rows or any(len(words) != columns for words in split):
        raise MalformedReply(f"an array of {len(body)} rows where {rows} rows of {columns} numbers were due")
    return np.array([[parse_float(word) for word in words] for words in split])
