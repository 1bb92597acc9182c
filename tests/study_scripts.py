"""Scripts of the studies as modules, which import those of their folder by bare name."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType

import pytest

STUDIES = Path(__file__).parents[1] / "benchmarks" / "studies"


@pytest.fixture
def import_study(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[str], ModuleType]]:
    """Imports a script by its path in the folder of the studies, such as ``registration/validation.py``."""

    def load(path: str) -> ModuleType:
        monkeypatch.syspath_prepend((STUDIES / path).parent)
        return importlib.import_module(Path(path).stem)

    yield load
    # Their names are common words.
    for script in STUDIES.glob("*/*.py"):
        sys.modules.pop(script.stem, None)
