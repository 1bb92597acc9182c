"""The benchmark of the loop's latency: both packages process every frame, and no process remains."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np
import pytest

from escape_benchmarks.real_time import latency
from escape_benchmarks.real_time.latency import LIMITS, LatencyResult, TimestampingMirror, run_loop
from escape_hw.streams import segments

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="shared memory as on Linux")


def of_others(one: segments.Segment) -> bool:
    """Whether a segment belongs to another test that runs now: neither our process nor our child's."""
    if one.pid == os.getpid() or not one.alive:
        return False
    try:
        parent = int(Path(f"/proc/{one.pid}/stat").read_text().rpartition(")")[2].split()[1])
    except FileNotFoundError:
        return False
    return parent != os.getpid()


@pytest.mark.parametrize("streams", [pytest.param(False, marks=pytest.mark.slow), True])
def test_frames_of_another_process_are_answered(monkeypatch, streams):
    monkeypatch.setattr(latency, "WARM_UP", 20)
    case = latency.make_case(4, 8, 12, 200.0)
    before = segments.segments("perf")
    found = run_loop(case, 0.5, streams=streams)
    assert found.latency_us.shape == (100,)
    assert (found.latency_us > 0).all()
    assert 20 < found.rate_hz < 400
    left = [one for one in segments.segments("perf") if one not in before and not of_others(one)]
    assert left == []


def test_every_rule_of_the_guard_is_in_the_way():
    assert None not in (LIMITS.max_slew, LIMITS.max_mean, LIMITS.max_neighbour)
    with TimestampingMirror(97) as mirror:
        sent = mirror.send(np.full(97, 0.7)).sent
        assert np.abs(sent).max() < 0.6
        assert len(mirror.times) == 1


def test_rows_show_losses_and_a_peer_that_failed():
    case = latency.make_case(4, 8, 12, 200.0)
    ours = LatencyResult(np.arange(1.0, 101.0), 200.0, 3, ("no real-time priority",))
    rows = latency._rows(case, ours, LatencyResult(np.array([150.0, 400.0]), 180.0, 0))
    assert [(row.ours, row.peer) for row in rows] == [
        (50.5, 150.0),
        (pytest.approx(99.01), 400.0),
        (100.0, None),
    ]
    assert "3 lost; no real-time priority; the peer answered 180 frames per second" in rows[0].note
    failed = latency._rows(case, ours, LatencyResult(np.array([]), 0.0, 0, ("timed out",)))
    assert [row.peer for row in failed] == [None, None, None]
    assert failed[0].note.endswith("timed out")
    assert "pyrtcao is not installed" in latency._rows(case, ours, None)[0].note
