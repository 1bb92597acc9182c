"""Log records of the front end and the engine: documents for clients, numbers, memory and a rotating file."""

from __future__ import annotations

import logging
import logging.handlers
import threading
from collections import deque
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

from escape_hw.errors import StorageError
from escape_hw.io.provenance import format_utc
from escape_hw.remote.state import LogLine

#: Longest text of a line, characters.
_MAX_TEXT = 4000
#: Lines kept in memory, bytes of a file, and number of older files.
_LINES, _BYTES, _FILES = 5000, 5_000_000, 4
_PACKAGES = ("escape_hw", "escape_sim", "escape_drivers")


class LogForwarder(logging.Handler):
    """Passes every record from INFO upwards to a function, as a line with number 0."""

    def __init__(self, forward: Callable[[LogLine], object]) -> None:
        super().__init__(logging.INFO)
        self._forward = forward
        self.setFormatter(logging.Formatter("%(message)s"))

    def emit(self, record: logging.LogRecord) -> None:
        """Forward one record."""
        try:
            at_utc = format_utc(datetime.fromtimestamp(record.created, UTC))
            text = self.format(record)[:_MAX_TEXT]
            self._forward(
                LogLine(number=0, at_utc=at_utc, level=record.levelname, logger=record.name, text=text)
            )
        except Exception:
            self.handleError(record)


def forward_log(forward: Callable[[LogLine], object]) -> LogForwarder:
    """Forward the records of ESCAPE's packages; returns the handler."""
    handler = LogForwarder(forward)
    for name in _PACKAGES:
        logging.getLogger(name).addHandler(handler)
    logging.getLogger("escape_hw").setLevel(logging.INFO)
    return handler


class ServerLog:
    """Numbers, stores and publishes the lines of front end and engine, in the thread that creates it.

    Lines of other threads, for example that of the check of keys, wait for :meth:`flush`.

    Raises
    ------
    StorageError
        The file cannot be written.
    """

    def __init__(self, path: Path, publish: Callable[[LogLine], object], first_number: int = 0) -> None:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = logging.handlers.RotatingFileHandler(
                path, maxBytes=_BYTES, backupCount=_FILES, encoding="utf-8"
            )
        except OSError as error:
            raise StorageError(
                f"{path}: the log of the server cannot be written ({error.strerror or error}); "
                "make its folder writable, or set XDG_DATA_HOME to another one"
            ) from error
        self._lines: deque[LogLine] = deque(maxlen=_LINES)
        self._next, self._publish = first_number, publish
        self._thread, self._waiting = threading.get_ident(), deque[LogLine]()
        #: Number of the newest line; -1 if there is none.
        self.last_number = -1
        self._level = logging.getLogger("escape_hw").level
        self._handler = forward_log(self.add)

    def add(self, line: LogLine) -> None:
        """Add a line of this process or the engine."""
        self._waiting.append(line)
        if threading.get_ident() == self._thread:
            self.flush()

    def flush(self) -> None:
        """Number and publish the lines that other threads have added."""
        while self._waiting:
            self._add(self._waiting.popleft())

    def _add(self, line: LogLine) -> None:
        line = line.model_copy(update={"number": self._next})
        self.last_number, self._next = self._next, self._next + 1
        self._lines.append(line)
        text = f"{line.at_utc} {line.level} {line.logger}: {line.text}"
        self._file.emit(logging.LogRecord(line.logger, logging.INFO, "", 0, text, None, None))
        self._publish(line)

    def after(self, number: int, count: int) -> list[LogLine]:
        """The newest ``count`` lines with a larger number."""
        return [line for line in self._lines if line.number > number][-count:]

    def close(self) -> None:
        """Stop logging."""
        for name in _PACKAGES:
            logging.getLogger(name).removeHandler(self._handler)
        logging.getLogger("escape_hw").setLevel(self._level)
        self.flush()
        self._file.close()
