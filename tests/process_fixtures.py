"""Real ``escape`` processes on a small twin."""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import preloaded
import pytest
from running import ESCAPE, Running
from small_system import configuration


@pytest.fixture(scope="session")
def system(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small bench as a system file."""
    path = tmp_path_factory.mktemp("system") / "small.toml"
    path.write_text(configuration().to_toml())
    return path


@pytest.fixture(scope="session")
def environment(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """One computing thread, no file outside the tests' folders, and Python's buffers as usual."""
    data = str(tmp_path_factory.mktemp("data"))
    inherited = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    return {**inherited, "OPENBLAS_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1", "XDG_DATA_HOME": data}


@pytest.fixture(scope="session")
def escape(environment: dict[str, str]) -> Callable[..., subprocess.CompletedProcess[str]]:
    """Run a command to its end."""

    def call(*words: object, **options: Any) -> subprocess.CompletedProcess[str]:
        told = [str(word) for word in words]
        if not options:
            return preloaded.run(told, environment)
        return subprocess.run(
            [*ESCAPE, *told],
            capture_output=True,
            text=True,
            check=False,
            timeout=120,
            env=environment,
            **options,
        )

    return call


@pytest.fixture(scope="session")
def im(escape: Callable[..., Any], system: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A matrix made by the command itself."""
    out = tmp_path_factory.mktemp("im") / "run"
    done = escape("calibrate", system, "--method", "docrime", "--frames", 400, "--out", out, "--json")
    assert done.returncode == 0, done.stderr
    return Path(json.loads(done.stdout)["products"]["im"])


@pytest.fixture
def start(environment: dict[str, str]) -> Iterator[Callable[..., Running]]:
    """Start a command; whatever still runs at the end of the test is killed."""
    running: list[Running] = []

    def call(*words: object) -> Running:
        running.append(Running([*words, "--json"], environment))
        return running[-1]

    yield call
    for process in running:
        process.kill()
