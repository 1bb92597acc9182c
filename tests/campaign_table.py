"""Table of the campaigns: what was tried, how often, with which result.

``pytest -m campaign --campaign-table docs/safety.md`` writes it between two marks of that page; rows of
campaigns that did not run stay.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest

BEGIN, END = "<!-- campaigns: begin -->", "<!-- campaigns: end -->"
_PROPERTY = "campaign"
_HEAD = ("| tried | times | result | run of |", "|---|---:|---|---|")


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
    day = time.strftime("%Y-%m-%d", time.gmtime())
    rows = {
        str(what): f"| {what} | {number} | {result} | {day} |"
        for report in reports
        for key, (what, number, result) in report.user_properties
        if key == _PROPERTY
    }
    if not rows:
        return
    terminalreporter.section("campaigns")
    terminalreporter.write_line("\n".join(rows.values()))
    page: Path | None = config.getoption("--campaign-table")
    if page is not None:
        before, rest = page.read_text(encoding="utf-8").split(BEGIN)
        table, after = rest.split(END)
        # Rows of campaigns that did not run now stay.
        old = {
            line.split(" | ")[0].removeprefix("| "): line
            for line in table.splitlines()
            if line.count("|") > 1
        }
        old = {what: line for what, line in old.items() if line not in _HEAD}
        lines = [*_HEAD, *(line for _, line in sorted({**old, **rows}.items()))]
        page.write_text("\n".join([f"{before}{BEGIN}", "", *lines, "", f"{END}{after}"]), encoding="utf-8")
