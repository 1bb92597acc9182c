"""Shared by the files that test the checks themselves."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from quick_benches import little_noise

from escape_hw.api.device import Device
from escape_hw.testing import run_checks

__all__ = ["catches", "little_noise"]


@pytest.fixture
def catches() -> Callable[[Callable[[], Device], str], None]:
    """Require that the named check, whatever others do, fails on a broken device and says why."""

    def require(broken: Callable[[], Device], expected: str) -> None:
        results = {result.check: result for result in run_checks(broken)}
        caught = results[f"check_{expected}"]
        failed = [name for name, result in results.items() if result.outcome == "failed"]
        assert caught.outcome == "failed", f"check_{expected} let it through; failed instead: {failed}"
        assert len(caught.message) > 20, f"the message does not help: {caught.message!r}"

    return require
