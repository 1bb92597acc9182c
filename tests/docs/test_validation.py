"""The validation study states what its raw tables contain."""

from __future__ import annotations

import numpy as np
import pytest
from pages import ROOT

FOLDER = ROOT / "docs" / "studies" / "validation"
SYSTEMS = {"razor-shwfs", "razor-pywfs", "revolt-shwfs", "maps-nir", "maps-vis"}
#: Tables of mirrors of another family.
OTHERS = sorted(FOLDER.glob("realisations-*.jsonl"))
#: Largest error that is vouched for, in standard errors.
MAX_PULL = 4.0


@pytest.fixture
def validation(import_study):
    return import_study("registration/validation.py")


def test_the_page_is_that_of_the_raw_tables(validation):
    tables = validation.measured_cases(FOLDER)
    assert {validation.CASES[name].system for name in tables} == SYSTEMS
    assert (FOLDER / "tables.md").read_text() == validation.page(tables)


def test_all_tables_are_complete_and_those_of_a_system_of_one_commit(validation):
    commits = {}
    for name, rows in validation.measured_cases(FOLDER).items():
        case = validation.CASES[name]
        assert [row["realisation"] for row in rows] == list(case.realisations)
        commits.setdefault(case.system, set()).update(row["commit"] for row in rows)
    assert all(len(found) == 1 for found in commits.values()), commits


def test_none_is_vouched_for_and_wrong(validation):
    for name, rows in validation.measured_cases(FOLDER).items():
        pulls = [np.divide(row["error"], row["sigma"]) for row in rows if row["converged"]]
        assert np.abs(pulls).max() < MAX_PULL, name


@pytest.mark.parametrize("table", OTHERS, ids=lambda path: path.stem)
def test_those_of_mirrors_of_another_family_neither(validation, table):
    rows = validation.read_lines(table)
    pulls = [np.divide(row["error"], row["sigma"]) for row in rows if row["converged"]]
    assert np.abs(pulls).max() < MAX_PULL


def test_the_limits_that_the_page_claims(validation):
    """Rms errors: shift in % of a sub-aperture, rotation in degrees, scalings in % of the diameter."""
    tables = validation.measured_cases(FOLDER)
    for name, limits in validation.LIMITS.items():
        errors = np.array([row["error"] for row in tables[name] if row["converged"]])
        assert (np.sqrt(np.mean(errors**2, axis=0)) <= np.repeat(limits, [2, 1, 2])).all(), name
    for name in ("dm97-1000", "dm97-50"):
        assert np.mean([row["matrix_error"] for row in tables[name]]) <= validation.MATRIX_LIMIT
