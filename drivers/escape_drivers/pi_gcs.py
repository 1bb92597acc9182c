"""PI's General Command Set 2.0 as text: lines out, replies in, no input or output of its own.

Rules (manual of the E-727, E727T0005): a command is a mnemonic and at most 32 arguments, ended by a line
feed. Every line of a reply but the last ends with a blank before the line feed, so a reply is complete
at the first line feed that follows no blank. Values come as ``1=0.000000000e+00``, arrays behind a
header of ``# KEY = value`` that ends with ``# END_HEADER``. USB pads with NUL.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

CODE = "cp1252"
#: Arguments of a line, and bytes of a reply, at most.
MAX_ARGUMENTS, MAX_REPLY = 32, 8 << 20


class Garbled(Exception):
    """A reply that is none to what was asked: link and controller no longer speak of the same thing."""


def line(mnemonic: str, *arguments: str | float) -> bytes:
    """A command as it goes over the wire.

    Raises
    ------
    ValueError
        More than 32 arguments, a number that is not finite, or text that would be two commands.
    """
    words = [mnemonic, *map(_word, arguments)]
    if len(arguments) > MAX_ARGUMENTS:
        raise ValueError(f"{mnemonic} with {len(arguments)} arguments; a line takes {MAX_ARGUMENTS}")
    if not all(word and word.isascii() and word.isprintable() and " " not in word for word in words):
        raise ValueError(
            f"{words!r} cannot be sent: an argument is empty or holds a blank or control character"
        )
    return " ".join(words).encode("ascii") + b"\n"


def _word(argument: str | float) -> str:
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
        """Bytes that belong to no complete reply yet, or that nobody took."""
        return len(self._buffer)

    def feed(self, data: bytes) -> None:
        """Add what arrived.

        Raises
        ------
        Garbled
            A reply without end.
        """
        self._buffer += data.replace(b"\0", b"")
        if len(self._buffer) > MAX_REPLY:
            size = len(self._buffer)
            self.clear()
            raise Garbled(f"{size} bytes without an end")

    def take(self) -> list[str] | None:
        """The lines of the first complete reply, without their ends; ``None`` while it is incomplete."""
        while (end := self._buffer.find(b"\n", self._searched)) >= 0:
            self._searched = end + 1
            if end == 0 or self._buffer[end - 1 : end] != b" ":
                reply = self._buffer[:end].decode(CODE, "replace")
                del self._buffer[: end + 1]
                self._searched = 0
                return [text.removesuffix("\r").removesuffix(" ") for text in reply.split("\n")]
        self._searched = len(self._buffer)
        return None

    def clear(self) -> None:
        """Forget everything."""
        self._buffer.clear()
        self._searched = 0


def single(reply: Sequence[str]) -> str:
    """The only line of a reply.

    Raises
    ------
    Garbled
        There are more.
    """
    if len(reply) != 1:
        raise Garbled(f"{len(reply)} lines where one was due: {reply[0][:40]!r} ...")
    return reply[0]


def real(text: str) -> float:
    """A finite number.

    Raises
    ------
    Garbled
        It is none.
    """
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise Garbled(f"{text[:40]!r} where a number was due")
    return value


def whole(text: str, base: int = 10) -> int:
    """A whole number, also with a prefix when ``base`` is 0.

    Raises
    ------
    Garbled
        It is none.
    """
    try:
        return int(text, base)
    except ValueError:
        raise Garbled(f"{text[:40]!r} where a whole number was due") from None


def values(reply: Sequence[str], keys: Sequence[str]) -> list[str]:
    """The values of lines ``KEY=value`` that must name just these keys, in this order.

    Raises
    ------
    Garbled
        Other keys, or another form.
    """
    pairs = [text.partition("=") for text in reply]
    found = [key.strip() for key, equals, _ in pairs if equals]
    if found != list(keys):
        raise Garbled(f"{' / '.join(reply)[:80]!r} where values of {', '.join(keys)} were due")
    return [value.strip() for _, _, value in pairs]


def reals(reply: Sequence[str], keys: Sequence[str]) -> list[float]:
    """As :func:`values`, finite numbers."""
    return [real(text) for text in values(reply, keys)]


def array(reply: Sequence[str], columns: int, rows: int) -> NDArray[np.float64]:
    """The numbers ``(rows, columns)`` of a reply to ``DRR?`` or ``GWD?``.

    Raises
    ------
    Garbled
        No header, or not that many numbers.
    """
    header = [k for k, text in enumerate(reply) if text.strip() == "# END_HEADER"]
    if len(header) != 1 or not all(text.startswith("#") for text in reply[: header[0]]):
        raise Garbled(f"{reply[0][:40]!r} ... where an array with a header was due")
    body = reply[header[0] + 1 :]
    split = [text.split() for text in body]
    if len(body) != rows or any(len(words) != columns for words in split):
        raise Garbled(f"an array of {len(body)} rows where {rows} rows of {columns} numbers were due")
    return np.array([[real(word) for word in words] for words in split])
