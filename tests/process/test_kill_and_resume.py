"""A killed calibration is resumed from its last state."""

from __future__ import annotations

import signal
import sys
import time

import pytest

from escape_hw.io.fits.matrix import load_matrix
from escape_hw.io.fits.run_state import load_state

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads processor time in /proc")


def killed(start, system, out, *words):
    """Start a calibration, kill it once it has kept a state a second time; the state."""
    running = start("calibrate", system, *words, "--set", "calibration.checkpoint_s=0.3", "--out", out)
    path, states = out / "run.state", set()
    deadline = time.monotonic() + 60
    while len(states) < 2 and time.monotonic() < deadline:
        if path.is_file():
            states.add(path.stat().st_mtime_ns)
        time.sleep(0.02)
    ended = running.stop(signal.SIGKILL)
    assert ended.code == -signal.SIGKILL
    assert len(states) == 2
    return load_state(path)


def test_kill_9_and_resume(start, system, tmp_path):
    first, second = tmp_path / "first", tmp_path / "second"
    state = killed(start, system, first, "--method", "docrime", "--frames", 10_000_000, "--poke", 0.01)
    taken = state.values["fed"]
    assert not (first / "result.json").exists()
    running = start("calibrate", "--resume", first, "--frames", taken + 2000, "--out", second)
    ended = running.stop()
    assert ended.code == 0, ended.lines
    assert ended.document["frames"] == taken + 2000
    matrix = load_matrix(second / "im.fits").matrix
    assert matrix.method == "docrime-whitened"
    assert matrix.metrics["poke"] == 0.01
    # The run is complete: there is nothing to resume.
    assert not (second / "run.state").exists()
