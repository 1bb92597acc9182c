"""The study of the constants states what its raw tables contain."""

from __future__ import annotations

import pytest
from pages import ROOT

from escape_benchmarks.realisation_tables import read_lines

TABLES = sorted((ROOT / "docs" / "studies" / "constants").glob("*.jsonl"))
PAGE = (ROOT / "docs" / "studies" / "constants.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("table", TABLES, ids=lambda path: path.stem)
def test_the_page_has_the_table_of_the_raw_one(table, capsys, import_study):
    rows = read_lines(table)
    import_study("registration/constants.py").print_table(rows)
    assert capsys.readouterr().out.rstrip() in PAGE
    assert min(row["realisation"] for row in rows) == 1000
    assert len({row["commit"] for row in rows}) == 1
