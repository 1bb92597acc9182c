"""The validation study states what its raw tables contain."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
TABLES = sorted((ROOT / "docs" / "studies" / "validation").glob("*.jsonl"))
FIRST_OF_VALIDATION = 1000


@pytest.mark.parametrize("table", TABLES, ids=lambda path: path.stem)
def test_the_page_has_the_statistics_of_the_raw_table(table, capsys, monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "benchmarks" / "studies")
    monkeypatch.delitem(sys.modules, "registration_errors", raising=False)
    from realisation_tables import read_lines
    from registration_errors import print_table

    rows = read_lines(table)
    print_table(rows)
    assert capsys.readouterr().out.rstrip() in (ROOT / "docs" / "studies" / "validation.md").read_text()
    numbers = [row["realisation"] for row in rows]
    assert numbers == sorted(set(numbers))
    assert numbers[0] == FIRST_OF_VALIDATION
    assert len({row["commit"] for row in rows}) == 1
    # None is vouched for and wrong by more than four standard errors.
    pulls = [np.divide(row["error"], row["sigma"]) for row in rows if row["converged"]]
    assert np.abs(pulls).max() < 4
