"""The paper's numbers and those of the twins: one row each, with the twin's where the run exists."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import fake_results as fake
import pytest
from synthetic_sweep import SWEPT, synthetic_run

from escape_hw.errors import ConfigError
from escape_hw.io.run_folder import RunFolder
from escape_hw.paper import results
from escape_hw.paper.cases import find_sweeps
from escape_hw.paper.results import write_results
from escape_hw.report.run_report import write_report
from escape_hw.runtime.sweep.products import sweep_document
from escape_hw.runtime.sweep.result import analyse_sweep


@pytest.fixture(scope="module")
def sweep_run(tmp_path_factory):
    with RunFolder("razor-shwfs", "sweep", tmp_path_factory.mktemp("sweep") / "run") as folder:
        head = {
            "schema": 1,
            "command": "sweep",
            "system": "razor-shwfs",
            "simulated": True,
            "seed": 1,
            "git": "abc123",
        }
        folder.write_result({**head, **sweep_document(analyse_sweep(SWEPT, synthetic_run(0.0), 0.01))})
    return folder.path


def test_without_runs_every_row_states_how_to_make_it(tmp_path):
    text = write_results(tmp_path / "results", {}).read_text()
    rows = [line for line in text.splitlines() if line.startswith("| ")][1:]
    assert len(rows) > 25
    assert all("(not run)" in row and "`escape " in row for row in rows)
    assert "Table 1, SHORT: Shift X [% of Sub Aperture] | −15.3 |" in text


def test_a_sweep_fills_its_rows_and_draws_its_figures(tmp_path, sweep_run):
    runs = find_sweeps([sweep_run])
    assert list(runs) == ["sweep-shwfs"]
    assert "Commit of the software: abc123." in write_results(tmp_path, runs).read_text()
    rows = json.loads((tmp_path / "results.json").read_text())["rows"]
    ours = {row["number"]: row["ours"] for row in rows if row["ours"]}
    assert ours["razor-shwfs: randomised trials"] == "80, 128 loops in all"
    assert "equivalent within" in ours["razor-shwfs: at their own best parameters"]
    assert "importance of the choice of matrix" in " ".join(ours)
    names = {path.name for path in tmp_path.glob("*.png")}
    assert names == {f"sweep-shwfs-{part}.png" for part in ("loops", "importance", "differences")}
    assert all(path.stat().st_size < 120_000 for path in tmp_path.glob("*.png"))


def test_the_report_describes_a_sweep(sweep_run):
    page = write_report(sweep_run).read_text()
    for words in ("Sweep", "equivalent within", "Importance by functional analysis", "dropped modes"):
        assert words in page


def test_what_is_no_sweep_of_the_papers_is_refused(tmp_path):
    (tmp_path / "result.json").write_text('{"system": "maps-nir", "sweep": {}, "products": {}}')
    with pytest.raises(ConfigError, match="--sweep"):
        find_sweeps([tmp_path])


def test_a_sweep_that_was_interrupted_is_not_taken_for_a_finished_one(sweep_run, tmp_path):
    document = json.loads((sweep_run / "result.json").read_text())
    (tmp_path / "result.json").write_text(json.dumps({**document, "partial": True}))
    with pytest.raises(ConfigError, match="unfinished; finish it"):
        find_sweeps([tmp_path])


@pytest.mark.parametrize(
    ("stable", "words"),
    [
        (True, "no Strehl ratio: the loops were too short"),
        (False, "no stable loop with the matrix of push-pull"),
    ],
)
def test_the_reason_for_no_strehl_ratio_is_stated(stable, words):
    loops = {
        "push-pull": replace(fake.loop("push-pull"), stable=stable, strehl=None),
        "ESCAPE": replace(fake.loop(), strehl=None),
    }
    assert results._difference(SimpleNamespace(loops=loops), "ESCAPE", "push-pull") == words
