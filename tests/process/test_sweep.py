"""A killed sweep loses no finished trial, leaves none running, and is completed when it is resumed."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest
from sweep_cases import LOOPS, ended, finished, kill, matrices, start, states, until, workers_of


@pytest.fixture(scope="module")
def arguments(tmp_path_factory) -> tuple[str, ...]:
    return matrices(tmp_path_factory.mktemp("matrices"))


def loops(run: Path) -> list[dict[str, str]]:
    with (run / "trials.csv").open() as table:
        return list(csv.DictReader(table))


@pytest.mark.campaign
@pytest.mark.timeout(1800)
def test_killed_workers_and_a_killed_sweep_lose_nothing(arguments, tmp_path):
    run, again = tmp_path / "run", tmp_path / "again"
    database = run / "study.db"
    first = start(*arguments, "--workers", "2", "--out", str(run))
    until(lambda: len(finished(database)) >= 2, process=first)
    # A worker is killed: its trials run again, and the sweep continues.
    kill(workers_of(first.pid)[0])
    seen = len(finished(database))
    until(lambda: len(finished(database)) >= seen + 3, process=first)
    # The sweep is killed, and its workers end with it.
    orphans = workers_of(first.pid)
    kill(first.pid)
    first.communicate(timeout=30)
    until(lambda: not any(Path(f"/proc/{pid}").exists() for pid in orphans), 30)
    before = finished(database)
    assert states(database).get("RUNNING", 0) > 0
    document = ended(start("--resume", str(run), "--out", str(again), "--workers", "1", "--json", "--quiet"))
    after = finished(database)
    assert {number: after[number] for number in before} == before
    assert set(states(database)) <= {"COMPLETE", "PRUNED", "FAIL"}
    assert sum(document["sweep"]["loops"].values()) == LOOPS
    assert len(loops(again)) == LOOPS
    assert set(document["best"]) == {"push-pull", "DO-CRIME"}
    assert (again / "report.html").stat().st_size > 10_000
    # Resumed again, nothing is left to run, and the result is shown.
    folders = sorted(path.name for path in tmp_path.iterdir())
    shown = ended(start("--resume", str(run), "--json", "--quiet"))
    assert (shown["folder"], shown["best"]) == (str(again), document["best"])
    assert sorted(path.name for path in tmp_path.iterdir()) == folders
    # The parameters do not depend on when and where the loops ran.
    drawn = {
        (row["matrix"], row["realisation"]): row["gain"] for row in loops(again) if row["stage"] == "explore"
    }
    assert all(drawn["push-pull", index] == gain for (_, index), gain in drawn.items())
