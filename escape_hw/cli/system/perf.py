"""``escape perf``: run the benchmarks and write their table into docs/performance.md."""

from __future__ import annotations

import os
import platform
from collections.abc import Sequence
from datetime import UTC, datetime
from importlib.metadata import EntryPoint, PackageNotFoundError, entry_points, version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer

from escape_hw.cli.command import command
from escape_hw.cli.context import CommandContext
from escape_hw.errors import ConfigError

if TYPE_CHECKING:
    from rich.table import Table

    from escape_hw.api.benchmark import Benchmark, BenchmarkRow


#: Headings of a table of measurements; :func:`format_row` fills a row.
COLUMNS = ("stage", "ours", "peer", "unit", "times better", "of floor", "peer is", "note")
#: Lines around the measured part of the page; the text outside stays.
BEGIN, END = "<!-- measured: begin -->", "<!-- measured: end -->"
_PACKAGES = ("escape-hw", "numpy", "scipy", "numba", "OOPAO", "pyrtcao", "specula", "synim")


def measurement_conditions() -> dict[str, Any]:
    """Machine, load and versions, as JSON values."""
    versions: dict[str, str | None] = {}
    for name in _PACKAGES:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            versions[name] = None
    return {
        "date": datetime.now(UTC).strftime("%Y-%m-%d"),
        "python": platform.python_version(),
        "machine": platform.machine(),
        "processor": _processor(),
        "cores": len(os.sched_getaffinity(0)),
        "load": round(os.getloadavg()[0], 1),
        "threads": 1,
        "versions": versions,
    }


def _processor() -> str:
    """The processor's name."""
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:
        return platform.processor()
    names = [line.split(":", 1)[1].strip() for line in text.splitlines() if line.startswith("model name")]
    return names[0] if names else platform.processor()


def require_page(page: Path) -> None:
    """Check that the table can be written into a page."""
    if page.exists():
        text = page.read_text(encoding="utf-8")
        if text.count(BEGIN) != 1 or text.count(END) != 1 or text.index(BEGIN) > text.index(END):
            raise ConfigError(f"{page} has no place for the table; put the lines {BEGIN} and {END} into it")
    elif not page.parent.is_dir():
        raise ConfigError(f"{page.parent} is no folder; name a page in an existing one")


def write_page(page: Path, rows: Sequence[BenchmarkRow], at: dict[str, Any]) -> None:
    """Write conditions and table between the marks of a page, or into a new page."""
    text = page.read_text(encoding="utf-8") if page.exists() else f"# Performance\n\n{BEGIN}\n{END}\n"
    before, rest = text.split(BEGIN)
    after = rest.split(END)[1]
    page.write_text(f"{before}{BEGIN}\n\n{render(rows, at)}\n{END}{after}", encoding="utf-8")


def format_row(row: BenchmarkRow) -> tuple[str, ...]:
    """The cells of a measurement, by :data:`COLUMNS`."""
    return (
        row.stage,
        f"{row.ours:.4g}",
        "-" if row.peer is None else f"{row.peer:.4g}",
        row.unit,
        "-" if row.ratio is None else f"{row.ratio:.2f}",
        "-" if row.reached is None else f"{row.reached:.0%}",
        row.peer_name,
        row.note,
    )


def render(rows: Sequence[BenchmarkRow], at: dict[str, Any]) -> str:
    """Conditions and table as Markdown."""
    versions = ", ".join(f"{name} {number}" for name, number in at["versions"].items() if number)
    missing = [name for name, number in at["versions"].items() if not number]
    lines = [
        f"{at['date']}, {at['processor']}, {at['cores']} cores, load average {at['load']} at the end; "
        f"Python {at['python']}, {versions}." + (f" Not installed: {', '.join(missing)}." if missing else ""),
        "",
        "| " + " | ".join(COLUMNS) + " |",
        "|---|---:|---:|---|---:|---:|---|---|",
    ]
    for row in rows:
        lines.append("| " + " | ".join(cell.replace("|", "/") for cell in format_row(row)) + " |")
    return "\n".join(lines) + "\n"


GROUP = "escape.benchmarks"


def find_benchmarks() -> dict[str, EntryPoint]:
    """Benchmark stages by name, in alphabetical order."""
    return dict(sorted((point.name, point) for point in entry_points(group=GROUP)))


def run_benchmarks(stages: Sequence[str] = ()) -> list[BenchmarkRow]:
    """Run the named benchmark stages, all of them by default."""
    from escape_hw.api.concurrency import limit_to_one_thread

    known = find_benchmarks()
    unknown = [name for name in stages if name not in known]
    if unknown:
        raise ConfigError(f"unknown stage {unknown[0]!r}; there are: {', '.join(known) or 'none'}")
    rows: list[BenchmarkRow] = []
    with limit_to_one_thread():
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
        **measurement_conditions(),
        "rows": [row.to_dict() for row in rows],
    }


@command("perf")
def perf(
    context: CommandContext,
    stages: Annotated[
        list[str] | None, typer.Argument(metavar="[STAGE]...", help="Stages to measure; all by default.")
    ] = None,
    page: Annotated[
        Path | None,
        typer.Option(
            "--markdown", metavar="FILE", help="Write the table into this page; its other text stays."
        ),
    ] = None,
) -> None:
    """Benchmark speed and accuracy beside OOPAO and pyRTC, on one thread each."""
    if page is not None:
        require_page(page)
    rows = run_benchmarks(stages or ())
    if page is not None:
        write_page(page, rows, measurement_conditions())
    context.show(_table(rows))
    context.result(document(rows))


def _table(rows: Sequence[BenchmarkRow]) -> Table:
    from rich.table import Table

    table = Table(*COLUMNS)
    for column in table.columns[1:3]:
        column.justify = "right"
    table.columns[4].justify = table.columns[5].justify = "right"
    for row in rows:
        table.add_row(*format_row(row))
    return table
