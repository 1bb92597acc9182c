"""A sweep with nothing left to run shows its result, and creates no other folder."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import fake_results as fake
import pytest
from small_system import configuration
from synthetic_sweep import SWEPT, synthetic_run

from escape_hw.io.documents import dumps, header_fields
from escape_hw.io.fits.matrix import save_matrix
from escape_hw.io.provenance import file_sha256
from escape_hw.io.run_folder import RunFolder
from escape_hw.runtime.sweep.description import SweepDescription
from escape_hw.runtime.sweep.design import MatrixVariant
from escape_hw.runtime.sweep.products import find_finished_result, sweep_document
from escape_hw.runtime.sweep.result import analyse_sweep


@pytest.fixture
def description(tmp_path: Path) -> SweepDescription:
    """A sweep of two matrices in the folder ``run``."""
    config, run = configuration(), tmp_path / "run"
    path = save_matrix(tmp_path / "im.fits", fake.calibration(), fake.ORIGIN)
    variants = tuple(MatrixVariant(name, False, path, file_sha256(path)) for name in ("push-pull", "ESCAPE"))
    swept = replace(SWEPT, config=config.to_toml(), variants=variants)
    one = SweepDescription(swept, f"sqlite:///{run / 'study.db'}", "sweep", "random", 0.01)
    with RunFolder("razor-shwfs", "sweep", run) as folder:
        folder.write_config(config.to_toml())
        one.save(folder.path)
    return one


def conclude_in(path: Path, description: SweepDescription, partial: bool = False) -> Path:
    """What a sweep writes at its end."""
    run = synthetic_run(0.0)
    run.partial = partial
    document = {
        **header_fields("sweep", "razor-shwfs", True, 1),
        **sweep_document(analyse_sweep(description.sweep, run, 0.01)),
        "finished_utc": "2026-11-22T00:00:00Z",
    }
    path.mkdir(exist_ok=True)
    (path / "result.json").write_text(dumps({**document, "products": {"report": "report.html"}}))
    (path / "report.html").write_text("a report")
    return path


def test_an_interrupted_run_is_not_finished(description: SweepDescription, tmp_path: Path) -> None:
    assert find_finished_result(tmp_path / "run", description) is None
    conclude_in(tmp_path / "run", description, partial=True)
    assert find_finished_result(tmp_path / "run", description) is None


@pytest.mark.parametrize(
    "words", [("--trials", 300), ("--gain", "0.1:0.5"), ("--set", "loop.leak=0.02"), ("--force",)]
)
def test_options_of_a_new_sweep_are_refused_with_the_one_to_resume(escape, description, tmp_path, words):
    code, out, err = escape("sweep", "--resume", tmp_path / "run", *words)
    assert (code, out) == (2, "")
    assert f"{words[0]}: a sweep that is resumed keeps its own" in err


@pytest.mark.parametrize("where", ["run", "elsewhere"])
@pytest.mark.slow
def test_resume_of_a_finished_sweep_shows_its_result(
    escape, document, description, tmp_path, monkeypatch, where
):
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    there = conclude_in(tmp_path / where, description)
    with description.open_study() as study:
        study.set_result_folder(str(there))
    before = sorted(path.name for path in tmp_path.iterdir())
    code, out, err = escape("sweep", "--resume", tmp_path / "run", "--out", tmp_path / "again")
    assert code == 0
    assert "nothing is left to run" in err
    assert str(there / "report.html") in out
    assert "push-pull" in out
    code, found, _ = document("sweep", "--resume", tmp_path / "run")
    assert (code, found["folder"]) == (0, str(there))
    assert set(found["best"]) == {"push-pull", "ESCAPE"}
    assert sorted(path.name for path in tmp_path.iterdir()) == before


def test_a_result_that_has_gone_is_made_again(description: SweepDescription, tmp_path: Path) -> None:
    with description.open_study() as study:
        study.set_result_folder(str(tmp_path / "gone"))
    assert find_finished_result(tmp_path / "run", description) is None
