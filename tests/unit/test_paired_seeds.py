"""`escape reproduce revolt`: equal turbulence for the matrices of a seed, divergence, aborts, numbers."""

from __future__ import annotations

import json
import os
import signal

import numpy as np
import pytest

import escape_hw
from escape_hw.errors import CalibrationError
from escape_hw.paper import paired_seeds
from escape_hw.paper.results import write_results
from escape_hw.pipeline.statistics import mean_interval

#: The registration of the stand-in, in place of that of the system.
INJECTED = [
    word
    for name, value in (
        ("shift_x", -16.0), ("shift_y", -71.0), ("rotation", -0.77), ("radial_scaling", 2.9),
        ("tangential_scaling", 0.0),
    )
    for word in ("--set", f"twin.registration.{name}={value}")
]  # fmt: skip
WORDS = ("reproduce", "revolt", "--seeds", 3, "--short", 1000, "--long", 5000, "--loop-frames", 321)


def revolt(document, tmp_path):
    return document(*WORDS, *INJECTED, "--out", tmp_path / "run")


def test_every_matrix_of_a_seed_starts_from_the_same_state(document, bench, tmp_path):
    code, found, err = revolt(document, tmp_path)
    assert code == 0, (err, found["criteria"])
    names = [(name, options.get("frames")) for name, options in bench.calls if name != "best_gain"]
    loops = 3 * [("closed_loop", 321)]
    # ESCAPE of the first seed is SHORT.
    assert names[:6] == [("escape", 1000), ("escape", 5000), ("push-pull", None), *loops]
    assert names[6:] == 2 * [("escape", 1000), ("push-pull", None), *loops]
    with_loops = [one for one in bench.benches if "loop" in one.screen_seen]
    # The mirror is the seed's, the turbulence that of no calibration and of no search.
    seeds = [(one.config.system.seed, one.config.twin.run_seed) for one in with_loops]
    assert seeds == 3 * [(1, 1)] + 3 * [(2, 2)] + 3 * [(3, 3)]
    assert all(one.closed for one in bench.benches)
    assert bench.benches[0].config.calibration.push_pull_frames == paired_seeds.PUSH_PULL_FRAMES


@pytest.mark.slow
def test_numbers_by_seed_are_saved_and_shown(escape, reports, bench, tmp_path):
    code, out, err = escape(*WORDS, *INJECTED, "--out", tmp_path / "run")
    assert code == 0, err
    for word in ("α SHORT", "α LONG", "ESCAPE minus push-pull", "95 % interval", "stable for every seed"):
        assert word in out
    page = (tmp_path / "run" / "report.html").read_text()
    for word in ("Paired loops", "ESCAPE minus DO-CRIME", "two-sided", "Stacked closed-loop PSFs"):
        assert word in page
    paired = json.loads((tmp_path / "run" / "result.json").read_text())["paired"]
    assert [one["seed"] for one in paired["seeds"]] == [1, 2, 3]
    assert paired["seeds"][0]["strehl"] == {"push-pull": 0.62, "DO-CRIME": 0.62, "ESCAPE": 0.62}
    assert {one["seeds"] for one in paired["differences"]} == {3}
    rows = write_results(tmp_path / "results", {"revolt": tmp_path / "run"}).read_text()
    assert "| REVOLT, Strehl of ESCAPE, mean over seeds | no number | 62.0 %, 3 seeds |" in rows
    assert "injected −71" in rows


def test_a_matrix_without_a_stable_loop_counts_with_zero(document, bench, monkeypatch, tmp_path):
    search = bench.find_best_gain

    def find_best_gain(twin, matrix, grid, **options):
        if matrix.method == "push-pull" and twin.config.system.seed == 2:
            raise CalibrationError("the loop closes at none of the gains 0.45, 0.64")
        return (yield from search(twin, matrix, grid, **options))

    monkeypatch.setattr("escape_hw.calibration.loop.gain_search.find_best_gain", find_best_gain)
    code, found, err = revolt(document, tmp_path)
    assert code == 0, err
    second = found["paired"]["seeds"][1]
    assert second["strehl"]["push-pull"] == 0
    assert second["stable"] == {"push-pull": False, "DO-CRIME": True, "ESCAPE": True}
    assert second["notes"] == ["push-pull: the loop closes at none of the gains 0.45, 0.64"]
    difference = next(one for one in found["paired"]["differences"] if one["second"] == "push-pull")
    assert difference["mean"] == pytest.approx(0.62 / 3)


def test_an_unstable_loop_of_escape_is_not_met(document, bench, tmp_path):
    def unstable(name: str) -> None:
        bench.changes = {"stable": False} if name == "closed_loop" else {}

    bench.hook = unstable
    code, found, _ = revolt(document, tmp_path)
    assert code == 1
    unmet = [check["text"] for check in found["criteria"] if not check["met"]]
    assert unmet == ["ESCAPE: loop stable for every seed (not for 1, 2, 3)"]


def test_ctrl_c_keeps_the_finished_seeds(document, bench, tmp_path):
    def stop(name: str) -> None:
        if bench.benches[-1].config.system.seed == 3:
            os.kill(os.getpid(), signal.SIGINT)

    bench.hook = stop
    code, found, _ = revolt(document, tmp_path)
    assert code == 130
    assert found["partial"] is True
    assert found["criteria"] == []
    assert [one["seed"] for one in found["paired"]["seeds"]] == [1, 2]
    assert len(found["paired"]["differences"]) == 3
    assert {"escape_short", "escape_long", "push_pull", "loop_escape"} <= set(found["products"])


def test_loops_too_short_for_a_strehl_ratio_are_refused(document, bench, tmp_path):
    code, found, _ = document(*WORDS[:-1], 100, "--out", tmp_path / "run")
    assert code == 2
    assert found["error"]["message"] == "loops of 100 frames give no Strehl ratio; use at least 270"
    assert bench.calls == []


def test_the_interval_is_students():
    found = mean_interval(np.array([1.0, 2.0, 3.0, 4.0, 5.0]))
    # t = 2.776 for four degrees of freedom; the standard error is sqrt(2.5 / 5).
    assert (found.mean, found.n) == (3.0, 5)
    assert (found.low, found.high) == pytest.approx((3 - 1.963, 3 + 1.963), abs=1e-3)
    assert str(found) == "+3.00, 95 % interval +1.04 to +4.96"
    assert str(mean_interval(np.array([1.0]))) == "+1.00 (one value, no interval)"


@pytest.mark.slow
@pytest.mark.timeout(900)  # calibrations and loops of two benches: against hanging, and not for speed
def test_two_seeds_of_the_twin():
    changes = [
        "basis.n_modes=12", "calibration.sprint_modes=12", "calibration.poke=0.02",
        "calibration.push_pull_frames=2",
    ]  # fmt: skip
    with escape_hw.open_system("revolt-shwfs", seed=1, set=changes) as bench:
        procedure = paired_seeds.reproduce_revolt(bench, short=250, long=300, loop_frames=270, seeds=2)
        result = bench.run(procedure)
    assert not result.partial
    assert [one.seed for one in result.seeds] == [1, 2]
    assert all(one.is_stable("ESCAPE") for one in result.seeds)
    assert (result.strehl("ESCAPE") > 0.1).all()
    # Mirrors and turbulence differ.
    assert abs(np.diff(result.strehl("ESCAPE"))) > 1e-4
