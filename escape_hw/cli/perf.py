"""``escape perf``: our speed and accuracy beside other packages', measured in one run."""

from __future__ import annotations

import argparse
import json
import platform
import sys
from collections.abc import Sequence
from importlib.metadata import EntryPoint, entry_points
from typing import TYPE_CHECKING, Any, cast

from escape_hw.errors import ConfigError, EscapeError

if TYPE_CHECKING:
    from escape_hw.api.benchmark import Benchmark, BenchmarkRow

GROUP = "escape.benchmarks"
_ABOUT = "Measure our speed and accuracy beside OOPAO's and pyRTC's, on one thread each."


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


def _head() -> dict[str, Any]:
    return {"schema": 1, "command": "perf", "system": "razor-shwfs", "simulated": True, "seed": 1}


def document(rows: Sequence[BenchmarkRow]) -> dict[str, Any]:
    """The JSON document."""
    return {
        **_head(),
        "python": platform.python_version(),
        "machine": platform.machine(),
        "rows": [row.to_dict() for row in rows],
    }


def main(arguments: Sequence[str]) -> int:
    """Measure our speed and accuracy beside OOPAO's and pyRTC's, on one thread each.

    Parameters
    ----------
    arguments
        Names of stages, all by default, and ``--json`` for one JSON document.

    Returns
    -------
    int
        Exit code: 0, also where a peer is not installed; 2 for a stage that does not exist.
    """
    parser = argparse.ArgumentParser(prog="escape perf", description=_ABOUT)
    parser.add_argument("stages", nargs="*", metavar="STAGE", help=f"one of: {', '.join(available())}")
    parser.add_argument("--json", action="store_true", help="print one JSON document")
    wanted = parser.parse_args(arguments)
    try:
        rows = measure(wanted.stages)
    except EscapeError as error:
        print(f"error: {error}", file=sys.stderr)
        if wanted.json:
            print(json.dumps({**_head(), "error": {"type": type(error).__name__, "message": str(error)}}))
        return error.exit_code
    if wanted.json:
        print(json.dumps(document(rows), indent=2, allow_nan=False))
    else:
        _print_table(rows)
    return 0


def _print_table(rows: Sequence[BenchmarkRow]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table("stage", "ours", "peer", "unit", "times better", "peer is", "note")
    for column in table.columns[1:3]:
        column.justify = "right"
    table.columns[4].justify = "right"
    for row in rows:
        table.add_row(
            row.stage,
            f"{row.ours:.4g}",
            "-" if row.peer is None else f"{row.peer:.4g}",
            row.unit,
            "-" if row.ratio is None else f"{row.ratio:.2f}",
            row.peer_name,
            row.note,
        )
    Console().print(table)
