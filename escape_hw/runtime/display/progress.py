"""Progress bars with the remaining time, on standard error."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, SpinnerColumn, TaskID, TextColumn
from rich.progress import Progress as RichProgress

from escape_hw.api.procedure import Progress
from escape_hw.runtime.display.notebook import NotebookProgress

#: Seconds between two lines without a terminal.
_LINE_PERIOD_S = 10.0


log = logging.getLogger(__name__)


class ProgressView:
    """Shows a procedure's progress: bars on a terminal or in a notebook, lines elsewhere.

    A display that fails, whatever the reason, is logged and ends; the procedure continues.
    """

    def __init__(self, console: Console, quiet: bool = False) -> None:
        self._console, self._quiet = console, quiet
        self._bars: RichProgress | None = None
        self._notebook: NotebookProgress | None = None
        self._task: TaskID | None = None
        self._stage: str | None = None
        self._last_line = 0.0

    def __enter__(self) -> Self:
        """Open the bars."""
        self._attempt(self._open)
        return self

    def _open(self) -> None:
        if self._console.is_jupyter:
            self._notebook = NotebookProgress()
        elif self._console.is_terminal:
            self._bars = RichProgress(
                SpinnerColumn(),
                TextColumn("{task.description}"),
                BarColumn(),
                MofNCompleteColumn(),
                TextColumn("{task.fields[unit]}"),
                TextColumn("{task.fields[left]}", style="cyan"),
                TextColumn("{task.fields[metrics]}", style="dim"),
                console=self._console,
            )
            self._bars.start()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the bars."""
        self._attempt(lambda: self._close(error is None))

    def __call__(self, progress: Progress) -> None:
        """Show one progress."""
        self._attempt(lambda: self._show(progress))

    def _attempt(self, action: Callable[[], object]) -> None:
        if self._quiet:
            return
        try:
            action()
        except (Exception, SystemExit) as error:
            # Rich ends the program when the reader of a pipe is gone.
            self._quiet = True
            log.info("progress is no longer shown: %s: %s", type(error).__name__, error)
            bars, self._bars = self._bars, None
            if bars is not None:
                try:
                    bars.stop()
                except (Exception, SystemExit) as second:
                    log.info("its display did not end cleanly: %s: %s", type(second).__name__, second)

    def _close(self, succeeded: bool) -> None:
        if self._notebook is not None and succeeded:
            self._notebook.finish()
        bars, self._bars = self._bars, None
        if bars is not None:
            bars.stop()

    def _show(self, progress: Progress) -> None:
        if self._notebook is not None:
            self._notebook.draw(progress.stage, progress.done, progress.total, _format_line(progress))
        elif self._bars is not None:
            self._draw(self._bars, progress)
        else:
            self._write(progress)

    def _draw(self, bars: RichProgress, progress: Progress) -> None:
        if progress.stage != self._stage or self._task is None:
            if self._task is not None:
                total = next(task.total for task in bars.tasks if task.id == self._task)
                bars.update(self._task, completed=total, left="done", metrics="")
            self._stage = progress.stage
            self._task = bars.add_task(
                progress.stage, total=progress.total, unit=f"{progress.unit}s", left="", metrics=""
            )
        bars.update(
            self._task,
            total=progress.total,
            completed=progress.done,
            left=_format_remaining(progress),
            metrics=_format_metrics(progress),
        )

    def _write(self, progress: Progress) -> None:
        now = time.monotonic()
        if progress.stage == self._stage and now - self._last_line < _LINE_PERIOD_S:
            return
        self._stage, self._last_line = progress.stage, now
        self._console.print(f"{progress.stage}: {_format_count(progress)}", highlight=False)


def _format_count(progress: Progress) -> str:
    of_total = f" of {progress.total}" if progress.total else ""
    left = _format_remaining(progress)
    return f"{progress.done}{of_total} {progress.unit}s" + (f", {left}" if left else "")


def _format_line(progress: Progress) -> str:
    return "  ".join(filter(None, (_format_count(progress), _format_metrics(progress))))


def _format_metrics(progress: Progress) -> str:
    return "  ".join(f"{name} {value:.3g}" for name, value in list(progress.metrics.items())[:3])


def _format_remaining(progress: Progress) -> str:
    """The time left; empty after the first step, which may include a compilation."""
    return format_time_left(progress.remaining_s) if progress.done > 1 else ""


def format_time_left(seconds: float) -> str:
    """Remaining time as text; empty while unknown."""
    if not 0 <= seconds < 1e7:
        return ""
    left = round(seconds)
    if left < 60:
        return f"{left} s left"
    if left < 3600:
        return f"{left // 60} min {left % 60:02d} s left"
    return f"{left // 3600} h {left % 3600 // 60:02d} min left"
