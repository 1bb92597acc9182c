"""Log records of the front end and the engine: conversion to documents for clients, numbering, memory and rotating file."""

from __future__ import annotations

import logging
import logging.handlers
from collections import deque
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

from escape_hw.io.provenance import format_utc
from escape_hw.remote.state import LogLine

#: A traceback is for the log file; a line for clients ends here.
_MAX_TEXT = 4000


class LogForwarder(logging.Handler):
    """Hands every record on as a line, from INFO upwards; the front numbers them."""

    def __init__(self, forward: Callable[[LogLine], object]) -> None:
        super().__init__(logging.INFO)
        self._forward = forward
        self.setFormatter(logging.Formatter("%(message)s"))

    def emit(self, record: logging.LogRecord) -> None:
        """Hand one record on."""
        try:
            self._forward(
                LogLine(
                    number=0,
                    at_utc=format_utc(datetime.fromtimestamp(record.created, UTC)),
                    level=record.levelname,
                    logger=record.name,
                    text=self.format(record)[:_MAX_TEXT],
                )
            )
        except Exception:
            self.handleError(record)


#: Lines that are kept in memory, bytes of a file, and files.
_LINES, _BYTES, _FILES = 5000, 5_000_000, 4
_PACKAGES = ("escape_hw", "escape_sim", "escape_drivers")


class ServerLog:
    """Numbers the lines of front and engine alike.

    Parameters
    ----------
    path
        The file; older ones get numbers.
    tell
        Gets every line.
    """

    def __init__(self, path: Path, publish: Callable[[LogLine], object]) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._lines: deque[LogLine] = deque(maxlen=_LINES)
        self._next, self._publish = 0, publish
        self._file = logging.handlers.RotatingFileHandler(
            path, maxBytes=_BYTES, backupCount=_FILES, encoding="utf-8"
        )
        self._handler = LogForwarder(self.add)
        package = logging.getLogger("escape_hw")
        self._level = package.level
        package.setLevel(logging.INFO)
        for name in _PACKAGES:
            logging.getLogger(name).addHandler(self._handler)

    def add(self, line: LogLine) -> None:
        """Take a line in, from this process or another."""
        line = line.model_copy(update={"number": self._next})
        self._next += 1
        self._lines.append(line)
        record = logging.LogRecord(
            line.logger,
            logging.INFO,
            "",
            0,
            f"{line.at_utc} {line.level} {line.logger}: {line.text}",
            None,
            None,
        )
        self._file.emit(record)
        self._publish(line)

    def after(self, number: int, count: int) -> list[LogLine]:
        """The newest lines after a number, at most so many."""
        return [line for line in self._lines if line.number > number][-count:]

    def close(self) -> None:
        """Hear no more."""
        for name in _PACKAGES:
            logging.getLogger(name).removeHandler(self._handler)
        logging.getLogger("escape_hw").setLevel(self._level)
        self._file.close()
