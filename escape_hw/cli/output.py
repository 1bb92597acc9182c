"""The standard streams of the command line, which may end before the command does.

Python keeps what is written to a pipe or a file, and writes it when the interpreter ends: too late for
an exit code of ours. So one place owns both streams while a command runs, and empties them before the
exit code is decided.
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
#: Exit code of a command whose results nobody got.
_FAILED = 1


class Stream:
    """A text stream that takes everything; what cannot be written is dropped, and the first time told.

    Parameters
    ----------
    inner
        The stream itself; ``None`` where the process was started without.
    descriptor
        Its file descriptor, in a process of its own.
    lost
        Called once, with the reason why it takes no more.
    """

    def __init__(self, inner: TextIO | None, descriptor: int, lost: Callable[[OSError], None]) -> None:
        self._lost, self._takes = lost, True
        self._absent = inner is None
        if inner is None:
            _occupy(descriptor)
            inner = open(os.devnull, "w", encoding="utf-8")
        self.inner = inner

    def write(self, text: str) -> int:
        """Write as far as it can be written."""
        self._attempt(lambda: self.inner.write(text))
        return len(text)

    def writelines(self, lines: Iterable[str]) -> None:
        """Write several."""
        for line in lines:
            self.write(line)

    def flush(self) -> None:
        """Empty the buffer as far as it can be written."""
        self._attempt(self.inner.flush, writes=False)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.inner, name)

    def _attempt(self, action: Callable[[], object], writes: bool = True) -> None:
        if not self._takes:
            return
        try:
            if self._absent and writes:
                raise OSError(errno.EBADF, os.strerror(errno.EBADF))
            action()
        except OSError as error:
            self._takes = False
            with contextlib.suppress(OSError, ValueError):
                # Or Python would write what is in the buffer at its end, and fail again.
                _to_nowhere(self.inner.fileno())
            self._lost(error)


class Output:
    """Both standard streams while a command runs.

    What standard output does not take is a failure of the command. What standard error does not take is
    not: whoever stops reading the progress still wants the result.

    Parameters
    ----------
    document
        Standard output is one document. A table may be cut off, as ``| head`` does, without a word; a
        document may not.
    """

    def __init__(self, document: bool) -> None:
        self._document, self._failed = document, False

    def __enter__(self) -> Self:
        """Take the streams over."""
        self._before = sys.stdout, sys.stderr
        self._errors = Stream(sys.stderr, 2, lambda error: None)
        self._results = Stream(sys.stdout, 1, self._lost)
        sys.stdout, sys.stderr = cast(TextIO, self._results), cast(TextIO, self._errors)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Empty them and give them back."""
        self._empty()
        sys.stdout, sys.stderr = self._before

    def verdict(self, code: T) -> T | int:
        """The exit code, once everything is written: no success if standard output took no more."""
        self._empty()
        return _FAILED if self._failed and not code else code

    def _empty(self) -> None:
        self._results.flush()
        self._errors.flush()

    def _lost(self, error: OSError) -> None:
        self._failed = True
        if self._document or not isinstance(error, BrokenPipeError):
            self._errors.write(f"error: standard output cannot be written ({error.strerror or error})\n")


def _occupy(descriptor: int) -> None:
    """Keep a standard descriptor that is closed from becoming that of the next file to be opened."""
    try:
        os.fstat(descriptor)
    except OSError:
        _to_nowhere(descriptor)


def _to_nowhere(descriptor: int) -> None:
    nowhere = os.open(os.devnull, os.O_WRONLY)
    if nowhere != descriptor:
        os.dup2(nowhere, descriptor)
        os.close(nowhere)
    else:
        os.set_inheritable(descriptor, True)
