"""``escape streams``."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

from escape_hw.cli.command import command
from escape_hw.cli.context import CommandContext

if TYPE_CHECKING:
    from rich.table import Table as RichTable

    from escape_hw.streams.monitor import StreamStatus

#: Seconds between two updates.
_PERIOD_S = 1.0


@command("streams")
def streams(
    context: CommandContext,
    remove_orphaned: Annotated[
        bool, typer.Option("--reap", help="Remove shared memory of dead servers.")
    ] = False,
    seconds: Annotated[
        float | None,
        typer.Option("--seconds", min=0, max=86400, help="How long to watch (default: until Ctrl-C)."),
    ] = None,
) -> None:
    """Show the streams of this computer's servers: rate, size, writer, readers, intervals.

    With --json, or without a terminal, it measures for a second and ends.
    """
    from escape_hw.streams.segments import remove_orphaned as clear

    removed = clear() if remove_orphaned else ()
    for segment in removed:
        context.notify(f"removed {segment.name}: its process {segment.pid} has ended")
    if remove_orphaned and not removed:
        context.notify("nothing to remove: the process of every stream is alive")
    rows = () if remove_orphaned else _watch_streams(context, seconds)
    documents = [
        {**asdict(row), "interval_us": dict(zip(("p50", "p99", "max"), row.interval_us, strict=True))}
        for row in rows
    ]
    context.report(streams=documents, removed=[segment.name for segment in removed])


def _watch_streams(context: CommandContext, seconds: float | None) -> tuple[StreamStatus, ...]:
    """Show the streams for a while; returns the last rows."""
    from rich.console import Console
    from rich.live import Live

    from escape_hw.streams.monitor import StreamMonitor

    table = StreamMonitor()
    table.rows()
    live = not context.json and Console().is_terminal
    until = time.monotonic() + (seconds if seconds is not None else math.inf if live else _PERIOD_S)
    if not live:
        time.sleep(max(0.05, until - time.monotonic()))
        rows = table.rows()
        context.show(_table(rows))
        return rows
    rows = table.rows()
    with Live(_table(rows), auto_refresh=False) as display:
        while time.monotonic() < until:
            time.sleep(min(_PERIOD_S, max(0.05, until - time.monotonic())))
            rows = table.rows()
            display.update(_table(rows), refresh=True)
    return rows


def _table(rows: Iterable[StreamStatus]) -> RichTable:
    from escape_hw.cli.formatting import rich_table
    from escape_hw.report.tables import Table

    headings = (
        "stream", "entries", "Hz", "shape", "MB", "writer", "readers", "age s", "interval us p50/p99/max",
    )  # fmt: skip
    cells = tuple(_cells(row) for row in rows)
    title = None if cells else "no streams: no server is running (start one with escape serve SYSTEM)"
    return rich_table(Table(headings, cells), title)


def _cells(row: StreamStatus) -> tuple[str, ...]:
    writer = str(row.pid) if row.alive else f"{row.pid} DEAD"
    shape = f"{'x'.join(map(str, row.shape))} {row.dtype}".strip()
    return (
        f"{row.system} {row.stream}", str(row.written), _number(row.rate_hz, ".1f"), shape,
        f"{row.size / 1e6:.1f}", writer, " ".join(map(str, row.readers)), _number(row.age_s, ".2f"),
        "/".join(_number(value, ".0f") for value in row.interval_us),
    )  # fmt: skip


def _number(value: float, form: str) -> str:
    return format(value, form) if math.isfinite(value) else "–"
