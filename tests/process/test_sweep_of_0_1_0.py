"""Sweeps of version 0.1.0 are read, and resumed where they stopped."""

from __future__ import annotations

import csv
import json
import shutil
import sqlite3
from pathlib import Path

import pytest
from sweep_cases import ended, finished, start, states

from escape_hw.runtime.sweep.description import read_description
from escape_hw.runtime.sweep.design import Slot
from escape_hw.runtime.sweep.trials import TrialSpec, run_trial

OLD = Path(__file__).parents[1] / "data" / "0.1.0"
#: Folder of the runs, as the stored paths have it.
HOME = "/home/user/runs"


@pytest.fixture
def runs(tmp_path) -> Path:
    """Copies of a finished and an unfinished sweep with their matrices; stored paths lead to the copies."""
    for name in ("escape", "sweep", "sweep-unfinished"):
        shutil.copytree(OLD / name, tmp_path / name)
    for name in ("sweep", "sweep-unfinished"):
        path = tmp_path / name / "sweep.json"
        path.write_text(path.read_text().replace(HOME, str(tmp_path)))
        connection = sqlite3.connect(tmp_path / name / "study.db")
        with connection:
            change = "update study_user_attributes set value_json = replace(value_json, ?, ?)"
            connection.execute(change, (HOME, str(tmp_path)))
        connection.close()
    return tmp_path


def loops(run: Path) -> dict[tuple[str, ...], dict[str, str]]:
    """Lines of ``trials.csv`` by stage, matrix, realisation and candidate."""
    with (run / "trials.csv").open() as table:
        return {tuple(list(row.values())[:4]): row for row in csv.DictReader(table)}


@pytest.mark.slow
def test_a_finished_sweep_shows_its_result(runs):
    stored = json.loads((OLD / "sweep" / "result.json").read_text())
    shown = ended(start("--resume", str(runs / "sweep"), "--json", "--quiet"))
    assert (shown["folder"], shown["best"]) == (str(runs / "sweep"), stored["best"])
    assert (runs / "sweep" / "report.html").stat().st_size > 10_000


@pytest.mark.slow
def test_a_finished_sweep_is_analysed_again(runs):
    """Without its result, the same conclusions are drawn from its trials."""
    stored, table = json.loads((OLD / "sweep" / "result.json").read_text()), loops(runs / "sweep")
    (runs / "sweep" / "result.json").unlink()
    again = ended(start("--resume", str(runs / "sweep"), "--out", str(runs / "again"), "--json", "--quiet"))
    assert again["sweep"]["loops"] == stored["sweep"]["loops"] == {"explore": 6, "shortlist": 24, "final": 40}
    assert (again["best"], again["comparisons"]) == (stored["best"], stored["comparisons"])
    for key, row in loops(runs / "again").items():
        assert list(row.values()) == list(table[key].values())


@pytest.mark.slow
def test_an_unfinished_sweep_is_resumed(runs):
    database = runs / "sweep-unfinished" / "study.db"
    before = finished(database)
    assert states(database)["RUNNING"] == 3
    document = ended(
        start("--resume", str(runs / "sweep-unfinished"), "--out", str(runs / "resumed"), "--json", "--quiet")
    )
    after = finished(database)
    assert {number: after[number] for number in before} == before
    assert set(states(database)) <= {"COMPLETE", "PRUNED", "FAIL"}
    assert document["sweep"]["loops"] == {"explore": 40, "shortlist": 24, "final": 40}
    assert document["sweep"]["design"]["final_replicates"] == 20
    # Both matrices run the same parameters on the same turbulence, before the interruption and after it.
    drawn = {key: row["gain"] for key, row in loops(runs / "resumed").items() if key[0] == "explore"}
    assert all(drawn["explore", "ESCAPE", number, "0"] == gain for (_, _, number, _), gain in drawn.items())


@pytest.mark.filterwarnings("ignore::escape_hw.deprecation.RenamedWarning")
def test_a_loop_has_the_strehl_ratio_that_version_0_1_0_measured(runs):
    sweep, row = read_description(runs / "sweep").sweep, loops(runs / "sweep")["explore", "ESCAPE", "1", "0"]
    values = {one.key: type(one.at(0.0))(row[one.key]) for one in sweep.space}
    outcome = run_trial(TrialSpec.from_slot(sweep, Slot("explore", "ESCAPE", 1), values))
    assert outcome["strehl"]["peak"]["value"] == pytest.approx(float(row["strehl_peak"]), abs=1e-3)
