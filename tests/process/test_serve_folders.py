"""``escape serve`` refuses folders that it cannot use, before it opens a device."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from serving import serving, until_idle


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


@pytest.mark.slow
def test_runs_of_a_later_server_have_other_names_and_earlier_matrices_are_loaded(
    system: Path, tmp_path: Path
) -> None:
    paths = []
    for number in (1, 2):
        with serving(system, folder=tmp_path) as served, served.connect(control=True) as bench:
            until_idle(bench)
            run = bench.start("docrime", frames=500)
            run.wait(120)
            assert run.id == number
            paths.append(bench.state.products[-1].path)
            if number == 2:
                bench.load_product(paths[0], "docrime-1")
                bench.load_product(paths[0])
                bench.load_product(paths[1])
                names = [one.name for one in bench.state.products]
                assert names == ["docrime-2", "docrime-1", "im", "im-2"]
                bench.load_product(paths[0], "docrime-1")
                assert len(bench.state.products) == 4
