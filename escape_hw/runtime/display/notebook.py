"""Progress in a notebook: one output that is updated in place, without widgets."""

from __future__ import annotations

import importlib
import time
from html import escape
from typing import Any

#: Seconds between two updates of the same stage.
_PERIOD_S = 0.2


class NotebookProgress:
    """One bar for each stage, below each other."""

    def __init__(self) -> None:
        # Installed wherever a notebook runs, and needed there only.
        self._display: Any = importlib.import_module("IPython.display")
        self._handle: Any = None
        self._finished_stages: list[str] = []
        self._stage, self._total = "", 0
        self._drawn = 0.0

    def draw(self, stage: str, done: int, total: int, text: str) -> None:
        """Update the bar of a stage; the first call creates the output."""
        now = time.monotonic()
        if stage == self._stage and done != total and now - self._drawn < _PERIOD_S:
            return
        if stage != self._stage:
            self._end_stage()
        self._stage, self._total, self._drawn = stage, total, now
        self._show(bar_html(stage, done, total, text))

    def finish(self) -> None:
        """Show the last stage as finished."""
        if self._handle is not None:
            self._end_stage()
            self._show("")

    def _end_stage(self) -> None:
        # A stage without a total only waited, and leaves no bar.
        if self._total:
            self._finished_stages.append(bar_html(self._stage, self._total, self._total, "done"))
        self._stage, self._total = "", 0

    def _show(self, last: str) -> None:
        html = self._display.HTML("".join((*self._finished_stages, last)))
        if self._handle is None:
            self._handle = self._display.display(html, display_id=True)
        else:
            self._handle.update(html)


def bar_html(stage: str, done: int, total: int, text: str) -> str:
    """One bar; a stage that runs until it is stopped has a total of 0, and an indeterminate bar."""
    place = f"value='{done}' max='{total}'" if total else ""
    return (
        "<div style='font-variant-numeric:tabular-nums'>"
        f"<progress {place} style='width:16em;vertical-align:middle'></progress> "
        f"{escape(stage)}: {escape(text)}</div>"
    )
