"""``escape serve`` refuses folders that it cannot use, before it opens a device."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest


@pytest.mark.timeout(60)
@pytest.mark.parametrize(
    "option",
    [("--read", "/nonexistent"), ("--read", "/dev/null"), ("--out", "/proc/x"), ("--out", "/dev/null")],
)
def test_a_folder_that_cannot_be_used_is_refused(
    escape: Callable[..., Any], system: Path, option: tuple[str, str]
) -> None:
    done = escape("serve", system, *option, "--json")
    assert done.returncode == 2, done.stderr
    error = json.loads(done.stdout)["error"]
    assert error["type"] == "StorageError"
    assert option[1] in error["message"]
