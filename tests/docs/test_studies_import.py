"""The scripts of the studies find what they import."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import pytest

STUDIES = Path(__file__).parents[2] / "benchmarks" / "studies"
NAMES = sorted(path.stem for path in STUDIES.glob("*.py"))


@pytest.mark.parametrize("name", NAMES)
def test_a_study_can_be_imported(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(STUDIES)
    try:
        importlib.import_module(name)
    finally:
        # Their names are common words.
        for other in NAMES:
            sys.modules.pop(other, None)
