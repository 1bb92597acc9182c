"""The study of the capture range states what its raw tables contain."""

from __future__ import annotations

import pytest
from pages import ROOT

from escape_benchmarks.realisation_tables import read_lines

TABLES = sorted((ROOT / "docs" / "studies" / "capture").glob("*.jsonl"))
PAGE = (ROOT / "docs" / "studies" / "capture-range.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("table", TABLES, ids=lambda path: path.stem)
def test_the_page_has_the_table_of_the_raw_one(table, capsys, import_study):
    rows = sorted(read_lines(table), key=lambda row: row["realisation"])
    import_study("registration/capture_range.py").print_table(rows)
    assert capsys.readouterr().out.rstrip() in PAGE
    assert [row["realisation"] for row in rows] == list(range(100))
    assert len({row["commit"] for row in rows}) == 1
    assert {row["outcome"] for row in rows} == {"recovered"}


def test_there_is_a_table():
    assert TABLES
