"""Standard streams of the command line that survive a closed pipe, a full disk and any locale.

Python writes buffered output when the interpreter exits, too late to change the exit code. The streams are
therefore flushed before the exit code is decided.
"""

from __future__ import annotations

import contextlib
import errno
import os
import sys
from collections.abc import Callable, Iterable
from types import TracebackType
from typing import Any, Self, TextIO, TypeVar, cast

from escape_hw.runtime.display.descriptors import redirect_to_null

T = TypeVar("T")
#: Exit code of a command whose results could not be written.
_FAILED = 1


#: Replacements for signs in the output that are not in ASCII.
_ASCII_SIGNS = str.maketrans(
    {
        "\N{MIDDLE DOT}": "-", "\N{BULLET}": "*", "\N{EN DASH}": "-", "\N{EM DASH}": "-",
        "\N{MULTIPLICATION SIGN}": "x", "\N{PLUS-MINUS SIGN}": "+-", "\N{MICRO SIGN}": "u",
        "\N{GREEK SMALL LETTER MU}": "u", "\N{DEGREE SIGN}": "deg", "\N{HORIZONTAL ELLIPSIS}": "...",
        "\N{RIGHTWARDS ARROW}": "->", "\N{LESS-THAN OR EQUAL TO}": "<=", "\N{GREATER-THAN OR EQUAL TO}": ">=",
        "\N{MINUS SIGN}": "-", "\N{ALMOST EQUAL TO}": "~", "\N{GREEK SMALL LETTER ALPHA}": "alpha",
        "\N{GREEK SMALL LETTER LAMDA}": "lambda", "\N{GREEK SMALL LETTER SIGMA}": "sigma",
        "\N{GREEK SMALL LETTER CHI}": "chi", "\N{GREEK CAPITAL LETTER DELTA}": "Delta",
        "\N{CHECK MARK}": "+", "\N{BALLOT X}": "x", "\N{SUPERSCRIPT TWO}": "^2",
        **{chr(code): "+" for code in range(0x2500, 0x2580)},
        "\N{BOX DRAWINGS LIGHT HORIZONTAL}": "-", "\N{BOX DRAWINGS HEAVY HORIZONTAL}": "-",
        "\N{BOX DRAWINGS LIGHT VERTICAL}": "|", "\N{BOX DRAWINGS HEAVY VERTICAL}": "|",
    }
)  # fmt: skip


def encodable(text: str, encoding: str | None) -> str:
    """The text in signs of an encoding: others become similar signs of ASCII, or escape sequences."""
    if encoding is None:
        return text
    try:
        text.encode(encoding)
    except UnicodeEncodeError:
        return text.translate(_ASCII_SIGNS).encode(encoding, "backslashreplace").decode(encoding)
    return text


class FaultTolerantStream:
    """A text stream that never raises; output that cannot be written is discarded.

    ``inner`` is ``None`` if the process was started without the stream. ``on_failure`` is called once, with
    the error of the first failed write.
    """

    def __init__(self, inner: TextIO | None, descriptor: int, on_failure: Callable[[OSError], None]) -> None:
        self._on_failure, self._works = on_failure, True
        self._absent = inner is None
        if inner is None:
            _reserve_descriptor(descriptor)
            inner = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115
        self.inner = inner

    def write(self, text: str) -> int:
        """Write, or discard if the stream has failed; signs that the encoding lacks are replaced."""
        writable = encodable(text, getattr(self.inner, "encoding", None))
        self._attempt(lambda: self.inner.write(writable))
        return len(text)

    def writelines(self, lines: Iterable[str]) -> None:
        """Write several lines."""
        for line in lines:
            self.write(line)

    def flush(self) -> None:
        """Flush the buffer, unless the stream has failed."""
        self._attempt(self.inner.flush, writes=False)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.inner, name)

    def _attempt(self, action: Callable[[], object], writes: bool = True) -> None:
        if not self._works:
            return
        try:
            if self._absent and writes:
                raise OSError(errno.EBADF, os.strerror(errno.EBADF))
            action()
        except (OSError, ValueError) as failure:
            # A ValueError: the stream has been closed.
            error = (
                failure if isinstance(failure, OSError) else OSError(errno.EBADF, os.strerror(errno.EBADF))
            )
            self._works = False
            with contextlib.suppress(OSError, ValueError):
                # Otherwise Python writes the buffer on exit and fails again.
                redirect_to_null(self.inner.fileno())
            self._on_failure(error)


class OutputStreams:
    """Replaces both standard streams while a command runs.

    A failure of standard output fails the command; a failure of standard error does not. A table may be cut
    off without a message, as by ``| head``; a ``document`` may not.
    """

    def __init__(self, document: bool) -> None:
        self._document, self._failed = document, False

    def __enter__(self) -> Self:
        """Replace the streams."""
        self._before = sys.stdout, sys.stderr
        self._errors = FaultTolerantStream(sys.stderr, 2, lambda error: None)
        self._results = FaultTolerantStream(sys.stdout, 1, self._on_failure)
        sys.stdout, sys.stderr = cast(TextIO, self._results), cast(TextIO, self._errors)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Flush and restore the streams."""
        self._flush()
        sys.stdout, sys.stderr = self._before

    def exit_code(self, code: T) -> T | int:
        """The exit code after flushing: ``code``, or 1 instead of success if standard output has failed."""
        self._flush()
        return _FAILED if self._failed and not code else code

    def _flush(self) -> None:
        self._results.flush()
        self._errors.flush()

    def _on_failure(self, error: OSError) -> None:
        self._failed = True
        if self._document or not isinstance(error, BrokenPipeError):
            self._errors.write(f"error: standard output cannot be written ({error.strerror or error})\n")


def _reserve_descriptor(descriptor: int) -> None:
    """Keep a closed standard descriptor from being reused for the next file that is opened."""
    try:
        os.fstat(descriptor)
    except OSError:
        redirect_to_null(descriptor)
