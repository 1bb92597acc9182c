"""``escape perf``: our speed and accuracy beside other packages', measured in one run."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer

from escape_hw.cli.perf_page import COLUMNS, cells, check_page, conditions, write_page
from escape_hw.cli.session import session
from escape_hw.errors import ConfigError

if TYPE_CHECKING:
    from rich.table import Table

    from escape_hw.api.benchmark import Benchmark, BenchmarkRow

GROUP = "escape.benchmarks"


def available() -> dict[str, EntryPoint]:
    """Benchmark stages by name, in alphabetical order."""
    return dict(sorted((point.name, point) for point in entry_points(group=GROUP)))


def measure(stages: Sequence[str] = ()) -> list[BenchmarkRow]:
    """Run benchmark stages.

    Parameters
    ----------
    stages
        Names; all of them by default.

    Raises
    ------
    ConfigError
        A stage does not exist.
    """
    from escape_hw.api.benchmark import one_thread

    known = available()
    unknown = [name for name in stages if name not in known]
    if unknown:
        raise ConfigError(f"unknown stage {unknown[0]!r}; there are: {', '.join(known) or 'none'}")
    rows: list[BenchmarkRow] = []
    with one_thread():
        for name in stages or known:
            benchmark = cast("Benchmark", known[name].load())
            rows += benchmark()
    return rows


def document(rows: Sequence[BenchmarkRow]) -> dict[str, Any]:
    """The JSON document."""
    return {
        "schema": 1,
        "system": "razor-shwfs",
        "simulated": True,
        "seed": 1,
        **conditions(),
        "rows": [row.to_dict() for row in rows],
    }


def perf(
    stages: Annotated[
        list[str] | None, typer.Argument(metavar="[STAGE]...", help="Stages to measure; all by default.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON document.")] = False,
    page: Annotated[
        Path | None,
        typer.Option("--markdown", metavar="FILE", help="Write the table into this page, prose untouched."),
    ] = None,
) -> None:
    """Measure our speed and accuracy beside OOPAO's and pyRTC's, on one thread each."""
    with session("perf", json=as_json) as one:
        if page is not None:
            check_page(page)
        rows = measure(stages or ())
        if page is not None:
            write_page(page, rows, conditions())
        one.show(_table(rows))
        one.result(document(rows))


def _table(rows: Sequence[BenchmarkRow]) -> Table:
    from rich.table import Table

    table = Table(*COLUMNS)
    for column in table.columns[1:3]:
        column.justify = "right"
    table.columns[4].justify = table.columns[5].justify = "right"
    for row in rows:
        table.add_row(*cells(row))
    return table
