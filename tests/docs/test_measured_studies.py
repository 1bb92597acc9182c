"""Studies of real matrices still give what their committed tables state."""

from __future__ import annotations

import json

import numpy as np
import pytest
from pages import ROOT
from shared_data import shared_data

from escape_benchmarks.realisation_tables import read_lines

STUDIES = ROOT / "docs" / "studies"
#: Two successive dates of the DM97 between which the bench was set up anew.
PAIR = ("20230901151656", "20230927150437")

# Minutes on an idle computer, beside other work more.
pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]


def assert_same_registration(new, old):
    """Whether two fits of one matrix agree, to a small part of the stated errors."""
    assert new["converged"] == old["converged"], new["warnings"]
    shifted = np.subtract(new["registration"], old["registration"])
    assert (np.abs(shifted) < 0.3 * np.array(old["sigma"])).all(), shifted / old["sigma"]
    np.testing.assert_allclose(new["sigma"], old["sigma"], rtol=0.3)


def test_the_matrices_of_irtf(import_study):
    folder = shared_data("irtf")
    study = import_study("measured/irtf_matrix.py")
    committed = json.loads((STUDIES / "irtf-matrix" / "irtf.json").read_text())
    found, measured, synthetic = study.fit(folder)
    assert measured.shape == synthetic.shape
    for file, new in found.items():
        old = committed[file]
        assert (new["orientation"], new["sign"]) == (old["orientation"], old["sign"])
        for solver in ("registration_only", "mixed_effects"):
            assert_same_registration(new[solver], old[solver])
            assert new[solver]["leaves"] == pytest.approx(old[solver]["leaves"], abs=0.005)
    scatter, night, _ = study.felix(folder / "felix")
    assert len(night) == scatter["n_matrices"]
    assert scatter["scatter_of_elements"] == pytest.approx(committed["felix"]["scatter_of_elements"])


def test_two_dates_of_the_dm97(import_study, monkeypatch, tmp_path):
    folder = shared_data("dm97")
    study = import_study("measured/measured_mirrors.py")
    entries = [entry for entry in study.read_entries(folder) if entry["date"] in PAIR]
    monkeypatch.setattr(study, "read_entries", lambda _: entries)
    study.measure(folder, tmp_path / "dm97.jsonl")
    committed = {line["date"]: line for line in read_lines(STUDIES / "measured-mirrors" / "dm97.jsonl")}
    lines = read_lines(tmp_path / "dm97.jsonl")
    assert tuple(line["date"] for line in lines) == PAIR
    for line in lines:
        old = committed[line["date"]]
        assert_same_registration(line, old)
        assert line["leaves"] == pytest.approx(old["leaves"], abs=0.005)
    later, old = lines[1], committed[PAIR[1]]
    assert later["earlier"] == old["earlier"] == PAIR[0]
    for leaves in ("moved_leaves", "measured_leaves", "synthetic_leaves"):
        assert later[leaves] == pytest.approx(old[leaves], abs=0.01)
    np.testing.assert_allclose(later["steady_eigenvalues"], old["steady_eigenvalues"], atol=0.02)


@pytest.mark.parametrize("system", ["twin", "dm97"])
def test_wrong_descriptions(system, import_study, monkeypatch, tmp_path):
    study = import_study("measured/wrong_descriptions.py")
    data = [] if system == "twin" else ["--data", str(shared_data("dm97"))]
    monkeypatch.setattr("sys.argv", ["wrong_descriptions.py", *data, "--out", str(tmp_path)])
    study.main()
    table = read_lines(STUDIES / "measured-mirrors" / "wrong-descriptions.jsonl")
    committed = {row["description"]: row for row in table if row["system"] == system}
    rows = read_lines(tmp_path / "wrong-descriptions.jsonl")
    assert {row["description"] for row in rows} == {*committed}
    for row in rows:
        assert row["converged"] == committed[row["description"]]["converged"], row
        # Never wrong and vouched for: a fit that converged is within its errors, and says what is wrong.
        if row["converged"]:
            assert (np.abs(row["error"]) < 4 * np.array(row["sigma"])).all(), row
            assert row["notes"] or row["description"] == "correct"


def test_the_published_matrix_of_maps(import_study, tmp_path):
    folder = shared_data("maps")
    study = import_study("measured/maps_matrix.py")
    committed = json.loads((STUDIES / "maps-matrix" / "maps.json").read_text())
    settings = study.published_settings(folder, tmp_path)
    result = study.import_published(folder, tmp_path, settings)
    model = study.make_fast_model(study.load_system("maps-vis", overrides=settings), result.grid)
    estimate = study.sprint(result.matrix, model, solver="registration-only", modes=study.N_FITTED)
    new = {
        "registration": estimate.registration.to_array(), "sigma": estimate.sigma,
        "converged": estimate.converged, "warnings": estimate.warnings,
    }  # fmt: skip
    assert_same_registration(new, committed)
    fitted = model.zonal_matrix(estimate.registration)
    assert study.correlation(result.matrix.data, fitted) == pytest.approx(
        committed["correlation"]["fitted"], abs=0.005
    )
