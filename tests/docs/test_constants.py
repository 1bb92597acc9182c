"""The study of the constants states what its raw tables contain."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
TABLES = sorted((ROOT / "docs" / "studies" / "constants").glob("*.jsonl"))


@pytest.mark.parametrize("table", TABLES, ids=lambda path: path.stem)
def test_the_page_has_the_table_of_the_raw_one(table, capsys, monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "benchmarks" / "studies")
    for name in ("constants", "realisation_tables"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    from constants import print_table
    from realisation_tables import read_lines

    rows = read_lines(table)
    print_table(rows)
    assert capsys.readouterr().out.rstrip() in (ROOT / "docs" / "studies" / "constants.md").read_text()
    assert min(row["realisation"] for row in rows) == 1000
    assert len({row["commit"] for row in rows}) == 1
