"""``escape streams``."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any

import typer

from escape_hw.cli import options
from escape_hw.cli.session import Session, session

if TYPE_CHECKING:
    from rich.table import Table as RichTable

    from escape_hw.streams.table import Row

#: Seconds between two looks.
_PERIOD_S = 1.0


def streams(
    reap: Annotated[bool, typer.Option("--reap", help="Remove what dead servers left behind.")] = False,
    seconds: Annotated[
        float | None, typer.Option("--seconds", min=0, help="How long to watch (default: until Ctrl-C).")
    ] = None,
    json: options.Json = False,
) -> None:
    """Watch the streams of this computer's servers: rate, size, who writes and reads, how regularly.

    With --json, or where the output is no terminal, it looks for a second and ends.
    """
    with session("streams", json=json) as one:
        from escape_hw.io.documents import head
        from escape_hw.streams.segments import reap as clear

        removed = clear() if reap else ()
        for segment in removed:
            one.tell(f"removed {segment.name}: its process {segment.pid} has ended")
        if reap and not removed:
            one.tell("nothing to remove: every stream's process lives")
        rows = () if reap else _watched(one, seconds)
        document = head("streams", None, None, None)
        one.result(
            {**document, "streams": [_plain(row) for row in rows], "removed": [s.name for s in removed]}
        )


def _watched(one: Session, seconds: float | None) -> tuple[Row, ...]:
    """Show the streams for a while; the last look."""
    from rich.console import Console
    from rich.live import Live

    from escape_hw.streams.table import StreamTable

    table = StreamTable()
    table.rows()
    live = not one.json and Console().is_terminal
    until = time.monotonic() + (seconds if seconds is not None else math.inf if live else _PERIOD_S)
    if not live:
        time.sleep(max(0.05, until - time.monotonic()))
        rows = table.rows()
        one.show(_view(rows))
        return rows
    rows = table.rows()
    with Live(_view(rows), auto_refresh=False) as shown:
        while time.monotonic() < until:
            time.sleep(min(_PERIOD_S, max(0.05, until - time.monotonic())))
            rows = table.rows()
            shown.update(_view(rows), refresh=True)
    return rows


def _view(rows: Iterable[Row]) -> RichTable:
    from escape_hw.cli.views import rich_table
    from escape_hw.report.tables import Table

    headings = (
        "stream",
        "entries",
        "Hz",
        "shape",
        "MB",
        "writer",
        "readers",
        "age s",
        "spacing us p50/p99/max",
    )
    cells = tuple(_cells(row) for row in rows)
    title = None if cells else "no streams: no server runs here (escape serve SYSTEM starts one)"
    return rich_table(Table(headings, cells), title)


def _cells(row: Row) -> tuple[str, ...]:
    writer = str(row.pid) if row.alive else f"{row.pid} DEAD"
    shape = f"{'x'.join(map(str, row.shape))} {row.dtype}".strip()
    return (
        f"{row.system} {row.stream}", str(row.written), _number(row.rate_hz, ".1f"), shape,
        f"{row.size / 1e6:.1f}", writer, " ".join(map(str, row.readers)), _number(row.age_s, ".2f"),
        "/".join(_number(value, ".0f") for value in row.interval_us),
    )  # fmt: skip


def _number(value: float, form: str) -> str:
    return format(value, form) if math.isfinite(value) else "–"


def _plain(row: Row) -> dict[str, Any]:
    p50, p99, largest = row.interval_us
    return {**asdict(row), "interval_us": {"p50": p50, "p99": p99, "max": largest}}
