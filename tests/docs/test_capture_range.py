"""The study of the capture range states what its raw tables contain."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
TABLES = sorted((ROOT / "docs" / "studies" / "capture").glob("*.jsonl"))


@pytest.mark.parametrize("table", TABLES, ids=lambda path: path.stem)
def test_the_page_has_the_table_of_the_raw_one(table, capsys, monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "benchmarks" / "studies")
    for name in ("capture_range", "realisation_tables"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    from capture_range import print_table
    from realisation_tables import read_lines

    rows = sorted(read_lines(table), key=lambda row: row["realisation"])
    print_table(rows)
    assert capsys.readouterr().out.rstrip() in (ROOT / "docs" / "studies" / "capture-range.md").read_text()
    assert [row["realisation"] for row in rows] == list(range(100))
    assert len({row["commit"] for row in rows}) == 1
    assert {row["outcome"] for row in rows} == {"recovered"}


def test_there_is_a_table():
    assert TABLES
