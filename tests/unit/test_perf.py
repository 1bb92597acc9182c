"""``escape perf``: rows, timing in turns, stages found by entry points."""

from __future__ import annotations

import importlib.metadata
import json
import math
import subprocess
import sys
from importlib.metadata import EntryPoint
from types import SimpleNamespace

import numpy as np
import pytest

from escape_benchmarks.calibration import docrime
from escape_benchmarks.calibration import docrime as docrime_frames
from escape_benchmarks.peers import pyrtcao as peer
from escape_benchmarks.real_time import pipeline
from escape_hw.api.benchmark import BenchmarkRow, time_alternately
from escape_hw.cli.system import perf
from escape_hw.errors import ConfigError


def row(ours=2.0, peer_figure=6.0, better="lower"):
    return BenchmarkRow("stage: what", ours, peer_figure, "peer 1.0", "us", better, "note")


#: What a run of 600 frames with two lost says of itself.
TAKEN = SimpleNamespace(solution=SimpleNamespace(frames=598, lost_frames=2))


def fake_stage() -> list[BenchmarkRow]:
    return [row()]


@pytest.fixture
def stages(monkeypatch):
    points = [EntryPoint(name, f"{__name__}:fake_stage", perf.GROUP) for name in ("second", "first")]
    monkeypatch.setattr(perf, "entry_points", lambda group: points)


def test_the_ratio_states_how_many_times_better():
    assert row().ratio == 3.0
    assert row(better="higher").ratio == pytest.approx(1 / 3)
    assert row(peer_figure=None).ratio is None
    assert row().to_dict() == {
        "stage": "stage: what",
        "ours": 2.0,
        "peer": 6.0,
        "peer_name": "peer 1.0",
        "unit": "us",
        "better": "lower",
        "note": "note",
        "floor": None,
        "ratio": 3.0,
        "reached": None,
    }


def test_two_functions_are_timed_in_turn(monkeypatch):
    calls, clock = [], [0.0]
    monkeypatch.setattr("escape_hw.api.benchmark.time.perf_counter", lambda: clock[0])

    def call(name, seconds):
        calls.append(name)
        clock[0] += seconds

    ours, theirs = time_alternately(
        lambda: call("a", 0.004), lambda: call("b", 0.012), seconds=0.05, rounds=3
    )
    assert (ours, theirs) == pytest.approx((0.004, 0.012))
    turns = [c for k, c in enumerate(calls) if k == 0 or calls[k - 1] != c]
    assert "".join(turns).endswith("ababab")
    assert time_alternately(lambda: call("a", 0.001), None, seconds=0.01)[1] is None


def test_stages_run_in_order_and_by_name(stages):
    assert list(perf.find_benchmarks()) == ["first", "second"]
    assert len(perf.run_benchmarks()) == 2
    assert len(perf.run_benchmarks(["second"])) == 1


def test_an_unknown_stage_is_refused_before_anything_runs(stages):
    with pytest.raises(ConfigError, match=r"'third'.*first, second"):
        perf.run_benchmarks(["first", "third"])


def test_the_document_is_strict_json(stages):
    document = json.loads(json.dumps(perf.document(perf.run_benchmarks(["first"])), allow_nan=False))
    assert document["schema"] == 1
    assert document["simulated"] is True
    assert set(document["rows"][0]) >= {"stage", "ours", "peer", "peer_name", "ratio", "unit"}


def test_the_stages_are_declared(request):
    text = (request.config.rootpath / "pyproject.toml").read_text()
    for name in ("docrime", "optics", "pipeline", "sprint"):
        assert f"\n{name} = " in text.split('"escape.benchmarks"]')[1].split("\n[")[0]


def test_a_missing_peer_is_a_row_without_a_figure(monkeypatch):
    monkeypatch.setattr(pipeline, "import_pyrtc", lambda module: None)
    monkeypatch.setattr(
        pipeline, "time_alternately", lambda ours, theirs: (1e-6, None if theirs is None else 2e-6)
    )
    rows = [one for one in pipeline.run() if "pyrtcao" in one.peer_name]
    assert len(rows) >= 4
    for one in rows:
        assert one.peer is None
        assert one.ratio is None
        assert "not installed" in one.note
        assert math.isfinite(one.ours)


def test_the_core_does_not_import_the_peer():
    code = (
        "import sys, escape_hw.cli.system.perf\n"
        "from escape_benchmarks.calibration import docrime\n"
        "from escape_benchmarks.real_time import pipeline\n"
        "print(sorted({'pyrtc', 'OOPAO', 'escape_sim'} & set(sys.modules)))"
    )
    env = {"PYTHONPATH": ":".join(p for p in sys.path if p)}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=env, timeout=120)
    assert done.stdout == "[]\n", done.stderr


def test_the_frames_of_the_docrime_stage_answer_one_frame_later(monkeypatch):
    monkeypatch.setattr(docrime, "_N_FRAMES", 1500)
    data = docrime.simulate_run(None)
    x, y = data.pokes[:-1].astype(float), data.slopes[1:].astype(float)
    assert data.error(np.linalg.solve(x.T @ x, x.T @ y).T) < 0.2
    assert data.error(docrime.estimate_recorded(data)) < 0.2
    assert np.allclose(docrime.estimate_recorded(data), docrime.estimate_streaming(data), rtol=0, atol=1e-4)


def test_the_docrime_run_counts_real_frames_against_the_benchs_rate(monkeypatch):
    ticks = iter([10.0, 12.0])
    monkeypatch.setattr(docrime_frames, "time", SimpleNamespace(perf_counter=lambda: next(ticks)))
    monkeypatch.setattr(docrime_frames, "drive", lambda run: (run.close(), TAKEN)[1])
    row = docrime.frames_row()
    assert row.ours == pytest.approx(600 / 2.0)
    assert row.peer == 500.0
    assert row.ratio == pytest.approx(0.6)
    assert "100000 take 333 s" in row.note


def test_turbulence_of_the_docrime_stage_has_unit_rms_and_falls_steeply():
    slow = docrime.frozen_flow_turbulence(np.random.default_rng(0))
    assert slow.std() == pytest.approx(1.0)
    power = (np.abs(np.fft.rfft(slow * np.hanning(len(slow))[:, None], axis=0)) ** 2).mean(axis=1)
    f = np.arange(len(power)) / len(slow)
    band = (f > 0.05) & (f < 0.2)
    slope = np.polyfit(np.log(f[band]), np.log(power[band]), 1)[0]
    assert slope == pytest.approx(-11 / 3, abs=0.2)


def test_the_peers_name_carries_its_version_where_it_is_installed():
    try:
        want = f"pyrtcao {importlib.metadata.version('pyrtcao')}: kernel"
    except importlib.metadata.PackageNotFoundError:
        want = "pyrtcao: kernel"
    assert peer.peer_name("kernel") == want
