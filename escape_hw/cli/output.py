"""Standard streams of the command line that survive a closed pipe or a full disk.

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

T = TypeVar("T")
#: Exit code of a command whose results could not be written.
_FAILED = 1


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
        """Write, or discard if the stream has failed."""
        self._attempt(lambda: self.inner.write(text))
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
        except OSError as error:
            self._works = False
            with contextlib.suppress(OSError, ValueError):
                # Otherwise Python writes the buffer on exit and fails again.
                _redirect_to_null(self.inner.fileno())
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
        _redirect_to_null(descriptor)


def _redirect_to_null(descriptor: int) -> None:
    null = os.open(os.devnull, os.O_WRONLY)
    if null != descriptor:
        os.dup2(null, descriptor)
        os.close(null)
    else:
        os.set_inheritable(descriptor, True)
