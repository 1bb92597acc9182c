"""Sweeps over real servers that are killed during the sweep. Slow; skipped where a server is missing."""

from __future__ import annotations

import importlib.util

import pytest
from sweep_cases import LOOPS, ended, finished, matrices, start, states, until
from sweep_servers import Dask, Postgres, postgres_binaries

BINARIES = postgres_binaries()
OUTCOMES = (
    "select t.number, md5(a.value_json) from trials t join trial_user_attributes a using (trial_id) "
    "where t.state in ('COMPLETE', 'PRUNED') and a.key = 'outcome' order by 1"
)
pytestmark = [pytest.mark.campaign, pytest.mark.timeout(1800)]


@pytest.fixture(scope="module")
def arguments(tmp_path_factory) -> tuple[str, ...]:
    return matrices(tmp_path_factory.mktemp("matrices"))


@pytest.fixture
def postgres():
    server = Postgres(BINARIES)
    yield server
    server.close()


@pytest.fixture
def dask():
    servers = Dask()
    yield servers
    servers.close()


@pytest.mark.skipif(BINARIES is None, reason="PostgreSQL is not installed (apt install postgresql)")
@pytest.mark.skipif(importlib.util.find_spec("psycopg") is None, reason="pip install 'escape-hw[postgresql]'")
def test_two_runners_share_a_postgresql_that_is_killed(arguments, postgres, tmp_path):
    def done() -> int:
        tables = postgres.ask("select count(*) from pg_tables where tablename = 'trials'")
        return len(postgres.ask(OUTCOMES)) if tables == ["1"] else 0

    run = tmp_path / "run"
    first = start(*arguments, "--workers", "1", "--storage", postgres.url, "--out", str(run))
    until(lambda: done() >= 2, process=first)
    second = start(
        "--resume", str(run), "--workers", "1", "--out", str(tmp_path / "joined"), "--json", "--quiet"
    )
    until(lambda: done() >= 6, process=second)
    before = postgres.ask(OUTCOMES)
    postgres.kill()
    postgres.start()
    documents = [ended(process) for process in (first, second)]
    after = postgres.ask(OUTCOMES)
    assert set(before) <= set(after)
    assert postgres.ask("select count(*) from trials where state in ('RUNNING', 'WAITING')") == ["0"]
    for document in documents:
        assert sum(document["sweep"]["loops"].values()) == LOOPS
    assert documents[0]["best"] == documents[1]["best"]
    # Both took part.
    hosts = postgres.ask("select distinct value_json from trial_user_attributes where key = 'host'")
    assert len(hosts) == 2


@pytest.mark.skipif(importlib.util.find_spec("distributed") is None, reason="pip install 'escape-hw[dask]'")
def test_a_sweep_survives_its_dask_workers_and_scheduler(arguments, dask, tmp_path):
    run = tmp_path / "run"
    database = run / "study.db"
    sweep = start(*arguments, "--scheduler", dask.address, "--out", str(run))
    until(lambda: len(finished(database)) >= 3, process=sweep)
    dask.workers[0].kill()
    seen = len(finished(database))
    until(lambda: len(finished(database)) >= seen + 3, process=sweep)
    before = finished(database)
    dask.kill_scheduler()
    dask.start()
    document = ended(sweep)
    after = finished(database)
    assert {number: after[number] for number in before} == before
    assert set(states(database)) <= {"COMPLETE", "PRUNED", "FAIL"}
    assert sum(document["sweep"]["loops"].values()) == LOOPS
