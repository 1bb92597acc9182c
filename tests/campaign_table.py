"""Table of the campaigns: what was tried, how often, with which result.

``pytest -m campaign --campaign-table docs/safety.md`` writes it between two marks of that page.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest

BEGIN, END = "<!-- campaigns: begin -->", "<!-- campaigns: end -->"
_PROPERTY = "campaign"


class Campaign:
    """Counts the outcomes of what a test tries."""

    def __init__(self, record_property: Callable[[str, object], None]) -> None:
        self._record = record_property
        self.outcomes: Counter[str] = Counter()
        self.failures: list[str] = []

    def count(self, outcome: str) -> None:
        """Count an outcome that is as promised."""
        self.outcomes[outcome] += 1

    def fail(self, description: str) -> None:
        """Count an outcome that breaks a promise."""
        self.failures.append(description)

    def end(self, what: str) -> None:
        """Record the row of the table; fails when a promise was broken."""
        counts = [f"{number} {outcome}" for outcome, number in sorted(self.outcomes.items())]
        broken = f"**{len(self.failures)} failures**" if self.failures else "no failure"
        self._record(
            _PROPERTY, (what, self.outcomes.total() + len(self.failures), "; ".join([broken, *counts]))
        )
        assert not self.failures, "\n".join([f"{len(self.failures)} failures", *self.failures[:20]])


@pytest.fixture
def campaign(record_property: Callable[[str, object], None]) -> Campaign:
    """The outcomes of this test."""
    return Campaign(record_property)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--campaign-table", type=Path, metavar="FILE", help="write the table of the campaigns into this page"
    )


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    reports = [*terminalreporter.getreports("passed"), *terminalreporter.getreports("failed")]
    rows = [
        (report.nodeid, row) for report in reports for key, row in report.user_properties if key == _PROPERTY
    ]
    if not rows:
        return
    at = f"Run of {time.strftime('%Y-%m-%d', time.gmtime())}."
    table = [at, "", "| tried | times | result |", "|---|---:|---|"]
    table += [f"| {what} | {number} | {result} |" for _, (what, number, result) in sorted(rows)]
    terminalreporter.section("campaigns")
    terminalreporter.write_line("\n".join(table))
    page: Path | None = config.getoption("--campaign-table")
    if page is not None:
        before, rest = page.read_text(encoding="utf-8").split(BEGIN)
        after = rest.split(END)[1]
        page.write_text("\n".join([f"{before}{BEGIN}", "", *table, "", f"{END}{after}"]), encoding="utf-8")
