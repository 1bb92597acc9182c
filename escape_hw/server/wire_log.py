"""Log records as lines for clients."""

from __future__ import annotations

import logging
from collections.abc import Callable
from datetime import UTC, datetime

from escape_hw.io.provenance import utc_text
from escape_hw.remote.state import LogLine

#: A traceback is for the log file; a line for clients ends here.
_LONGEST = 4000


class WireLog(logging.Handler):
    """Hands every record on as a line, from INFO upwards; the front numbers them."""

    def __init__(self, tell: Callable[[LogLine], object]) -> None:
        super().__init__(logging.INFO)
        self._tell = tell
        self.setFormatter(logging.Formatter("%(message)s"))

    def emit(self, record: logging.LogRecord) -> None:
        """Hand one record on."""
        try:
            self._tell(
                LogLine(
                    number=0,
                    at_utc=utc_text(datetime.fromtimestamp(record.created, UTC)),
                    level=record.levelname,
                    logger=record.name,
                    text=self.format(record)[:_LONGEST],
                )
            )
        except Exception:
            self.handleError(record)
