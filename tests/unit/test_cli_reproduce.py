"""The commands that reproduce the paper judge and report their own results."""

from __future__ import annotations

import re

import fake_bench
import pytest

from escape_hw.io.fits.loop import load_loop
from escape_hw.paper.cases import CASES


@pytest.mark.usefixtures("reports")
def test_reproduce_shwfs_shows_registration_strehl_and_report(escape, bench, tmp_path):
    run = tmp_path / "run"
    code, out, err = escape("reproduce", "shwfs", "--out", run, "--loop-frames", 321, "--realisations", 0)
    assert code == 0, err
    for word in ("injected", "Shift Y", "push-pull", "DO-CRIME", "ESCAPE", "OTF", "±"):
        assert word in out
    assert out.strip().splitlines()[-1] == f"report: {run / 'report.html'}"
    assert bench.benches[0].screen_seen == {
        "push-pull": False,
        "escape": True,
        "model_psf": False,
        "loop": True,
    }
    loops = [options for name, options in bench.calls if name == "closed_loop"]
    assert [loop["method"] for loop in loops] == ["push-pull", "docrime-whitened", "escape"]
    assert all(loop["gain"] == 0.35 and loop["frames"] == 321 for loop in loops)
    assert bench.benches[0].config.twin.registration.shift_y == -71.0
    page = (run / "report.html").read_text()
    for word in ("SIMULATED", "SPRINT convergence", "Stacked closed-loop PSFs", "Search for each matrix"):
        assert word in page
    assert load_loop(run / "loop_escape.fits").header["PARENT1"] == "escape.fits"


def test_reproduce_judges_its_own_result(document, bench, tmp_path):
    words = ("reproduce", "shwfs", "--out", tmp_path / "run", "--realisations", 0)
    code, found, _ = document(*words, "--set", "twin.registration.shift_x=30")
    assert code == 1
    failed = [check["text"] for check in found["criteria"] if not check["met"]]
    assert len(failed) == 1
    assert "injected registration" in failed[0]


def test_a_foreign_simulation_is_not_judged_by_the_twin_section(document, bench, monkeypatch, tmp_path):
    opened = fake_bench.FakeBench.__enter__

    def enter(self):
        self.dm.applies_twin_section = False
        return opened(self)

    monkeypatch.setattr(fake_bench.FakeBench, "__enter__", enter)
    words = ("reproduce", "shwfs", "--out", tmp_path / "run", "--realisations", 0)
    code, found, _ = document(*words, "--set", "twin.registration.shift_x=30")
    assert code == 0
    assert found["injected"] is None
    assert not [check for check in found["criteria"] if "injected" in check["text"]]


@pytest.mark.usefixtures("reports")
def test_reproduce_table1_is_shown_in_its_report(escape, tmp_path):
    run = tmp_path / "run"
    assert escape("reproduce", "table1", "--out", run, "--short", 1000, "--long", 5000)[0] == 0
    page = (run / "report.html").read_text()
    for word in ("SIMULATED", "SPRINT convergence", "α SHORT", "α LONG"):
        assert word in page, word


def test_reproduce_table1(escape, document, bench, tmp_path):
    words = ("reproduce", "table1", "--out", tmp_path / "run", "--short", 1000, "--long", 5000)
    code, out, _ = escape(*words)
    assert code == 0
    assert "α SHORT" in out
    assert "α LONG" in out
    assert [options["frames"] for _, options in bench.calls] == [1000, 5000]
    code, found, _ = document(*words)
    assert set(found["table1"]) == {"SHORT", "LONG"}
    assert sum("agree" in check["text"] for check in found["criteria"]) == 5
    assert set(found["products"]) == {
        "docrime_short", "escape_short", "docrime_long", "escape_long", "report",
    }  # fmt: skip


@pytest.mark.usefixtures("reports")
def test_reproduce_maps_shows_the_matrix_beside_its_simulation(escape, bench, tmp_path):
    run = tmp_path / "run"
    code, out, err = escape("reproduce", "maps", "--out", run, "--frames", 4000, "--loop-frames", 321)
    # The stand-in's registration is not the one injected in this system.
    assert code == 1, err
    assert bench.benches[0].config.system.name == "maps-nir"
    names = [name for name, _ in bench.calls]
    assert names == ["escape", "best_gain", "closed_loop", "best_gain", "closed_loop", "simulated"]
    assert "DO-CRIME" in out
    assert "ESCAPE minus DO-CRIME" in out
    page = (run / "report.html").read_text()
    for word in ("simulation", "contaminated mirror", "Stacked closed-loop PSFs"):
        assert word in page
    assert load_loop(run / "loop_docrime.fits").header["PARENT1"] == "docrime.fits"


@pytest.mark.usefixtures("empty_reports", "pictures")
@pytest.mark.slow
def test_reproduce_all_leads_to_every_report(escape, document, bench, tmp_path):
    words = ("reproduce", "all", "--out", tmp_path / "all", "--only", "maps", "--only", "table1")
    code, out, _ = escape(*words, "--share", 0.1)
    assert code == 1
    assert [options["frames"] for name, options in bench.calls if name == "escape"] == [1000, 10_000, 6000]
    page = (tmp_path / "all" / "index.html").read_text()
    for part in ("table1", "maps"):
        assert f'href="{part}/report.html"' in page
        assert (tmp_path / "all" / part / "report.html").is_file()
    assert any("index.html" in line for line in out.splitlines())
    assert (tmp_path / "all" / "results.md").is_file()
    pictures = list((tmp_path / "all").glob("*.png"))
    assert {"table1-convergence.png", "maps-matrices.png"} <= {path.name for path in pictures}, pictures
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in pictures)
    code, found, _ = document(*words)
    assert list(found["parts"]) == ["table1", "maps"]
    assert document("reproduce", "all", "--out", tmp_path / "x", "--only", "mops")[0] == 2
    assert not (tmp_path / "x").exists()


def test_too_small_a_share_is_refused_before_anything_runs(document, bench, tmp_path):
    words = ("reproduce", "all", "--out", tmp_path / "all", "--share")
    code, found, _ = document(*words, 0.005)
    assert code == 2
    said = re.fullmatch(
        r"--share 0\.005: too small; (\w+) needs at least (\d+) frames \((\w+)\) and would get (\d+) of (\d+)"
        r"; the least is --share (\S+)",
        found["error"]["message"],
    )
    kind, least, name, got, full = said[1], int(said[2]), said[3], int(said[4]), int(said[5])
    assert CASES[kind].frames[name] == full
    assert got == CASES[kind].scaled_frames(0.005)[name] < least
    assert bench.benches == []
    assert not (tmp_path / "all").exists()
    # What it says is enough is enough, and no more than that.
    code, found, _ = document(*words, float(said[6]) - 0.001)
    assert code == 2
    code, found, err = document(*words, said[6], "--only", kind)
    assert "too small" not in err
    assert found["parts"][kind]


@pytest.mark.usefixtures("empty_reports")
@pytest.mark.slow
def test_reproduce_all_continues_where_it_was(document, bench, tmp_path):
    words = ("reproduce", "all", "--out", tmp_path / "all", "--share", 0.1)
    first = document(*words, "--only", "maps")[1]["parts"]["maps"]
    calls = len(bench.calls)
    _, found, err = document(*words, "--only", "maps", "--only", "table1", "--resume")
    assert "maps: finished" in err
    assert [name for name, _ in bench.calls[calls:]] == ["escape", "escape"]
    assert list(found["parts"]) == ["table1", "maps"]
    assert found["parts"]["maps"]["finished_utc"] == first["finished_utc"]
    assert 'href="maps/report.html"' in (tmp_path / "all" / "index.html").read_text()
    # A run with other settings is not used.
    for other in (("--share", 0.2), ("--seed", 5), ("--set", "loop.gain=0.2")):
        code, refused, _ = document(*words, "--only", "maps", "--resume", *other)
        assert code == 2
        assert "was run with" in refused["error"]["message"]


@pytest.mark.usefixtures("empty_reports")
def test_reproduce_all_takes_no_other_run_for_its_own(document, tmp_path):
    document("reproduce", "table1", "--out", tmp_path / "all" / "maps")
    words = ("reproduce", "all", "--out", tmp_path / "all", "--only", "maps", "--resume")
    code, found, _ = document(*words)
    assert code == 2
    assert "reproduce table1" in found["error"]["message"]
