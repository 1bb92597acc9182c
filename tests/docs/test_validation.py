"""The validation study states what its raw tables contain."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "docs" / "studies" / "validation"


@pytest.fixture
def validation(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "benchmarks" / "studies")
    for name in ("registration_errors", "realisation_tables", "matrix_agreement", "validation"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    import validation

    return validation


def test_the_page_is_that_of_the_raw_tables(validation):
    tables = validation.measured_cases(FOLDER)
    assert set(tables) == set(validation.CASES)
    assert (FOLDER / "tables.md").read_text() == validation.page(tables)


def test_all_tables_are_complete_and_of_one_commit(validation):
    tables = validation.measured_cases(FOLDER)
    for rows in tables.values():
        assert [row["realisation"] for row in rows] == list(validation.REALISATIONS)
    assert len({row["commit"] for rows in tables.values() for row in rows}) == 1


def test_none_is_vouched_for_and_wrong_by_more_than_four_standard_errors(validation):
    for rows in validation.measured_cases(FOLDER).values():
        pulls = [np.divide(row["error"], row["sigma"]) for row in rows if row["converged"]]
        assert np.abs(pulls).max() < 4


def test_the_limits_that_the_page_claims(validation):
    """Rms errors: shift in % of a sub-aperture, rotation in degrees, scalings in % of the diameter."""
    tables = validation.measured_cases(FOLDER)
    for name, limits in validation.LIMITS.items():
        errors = np.array([row["error"] for row in tables[name] if row["converged"]])
        assert (np.sqrt(np.mean(errors**2, axis=0)) <= np.repeat(limits, [2, 1, 2])).all(), name
    for name in ("dm97-1000", "dm97-50"):
        assert np.mean([row["matrix_error"] for row in tables[name]]) <= validation.MATRIX_LIMIT
