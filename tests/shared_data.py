"""Real matrices beside the project, which tests use where they exist."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

SHARED = Path(os.environ.get("ESCAPE_SHARED_DATA", Path(__file__).parents[2] / "shared" / "data"))


def shared_data(name: str) -> Path:
    """The folder of a data set; the test is skipped where it does not exist."""
    folder = SHARED / name
    if not folder.is_dir():
        pytest.skip(f"no measured data in {folder} (ESCAPE_SHARED_DATA)")
    return folder
