"""Plugin for pytest: processor time of the tests of each folder, with that of the processes that they start.

``PYTHONPATH=tests python -m pytest -p folder_times -n 0``. Unlike wall time it hardly depends on the load of
the computer. What a fixture is shared by counts for the first test that needs it.
"""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Iterator

import pytest

_seconds: dict[str, float] = defaultdict(float)
_tests: dict[str, int] = defaultdict(int)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    before = sum(os.times()[:4])
    result = yield
    folder = item.path.parent.name
    _seconds[folder] += sum(os.times()[:4]) - before
    _tests[folder] += 1
    return result


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    terminalreporter.section("processor time by folder")
    for folder in sorted(_seconds, key=lambda name: -_seconds[name]):
        terminalreporter.line(f"{folder:20} {_tests[folder]:6} tests {_seconds[folder]:8.1f} s")
