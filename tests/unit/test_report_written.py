"""A result names its report when that is written."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from escape_hw.io.run_folder import RunFolder, read_result
from escape_hw.runtime.procedures import products

if TYPE_CHECKING:
    from pathlib import Path


class _Killed(BaseException):
    """As the end of the process."""


def test_a_run_killed_while_its_report_is_built_names_no_missing_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def killed(_: Path) -> Path:
        raise _Killed

    monkeypatch.setattr(products, "write_report", killed)
    with pytest.raises(_Killed), RunFolder("bench", "calibrate", tmp_path / "run") as folder:
        products.write_run_result(folder, {"partial": False, "products": {}})
    assert read_result(tmp_path / "run")["products"] == {}


def test_a_complete_run_names_its_report(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(products, "write_report", lambda folder: folder / products.REPORT)
    with RunFolder("bench", "calibrate", tmp_path / "run") as folder:
        products.write_run_result(folder, {"partial": False, "products": {}})
    assert set(read_result(tmp_path / "run")["products"]) == {"report"}
