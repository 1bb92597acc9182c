"""An interrupted calibration of a pyramid is resumed on a modulator that was parked since."""

from __future__ import annotations

import threading

import pytest
from small_pyramid import small

from escape_hw.api.procedure import run as run_procedure
from escape_hw.calibration.acquisition.checkpoint import Checkpoint
from escape_hw.errors import Aborted
from escape_hw.runtime.procedures.calibration import calibrate_with_method

FRAMES = 400


@pytest.mark.slow
def test_resumed_run_starts_the_modulator(tmp_path, monkeypatch):
    monkeypatch.setattr("escape_hw.api.procedure.Reporter.PERIOD_S", 0.0)
    abort = threading.Event()

    def interrupt(progress):
        if progress.stage == "DO-CRIME" and progress.fraction > 0.75:
            abort.set()

    first, second = tmp_path / "first.state", tmp_path / "second.state"
    with small() as bench:
        run = calibrate_with_method(bench, "docrime", frames=FRAMES, checkpoint=Checkpoint(first, None))
        with pytest.raises(Aborted):
            run_procedure(run, observers=(interrupt,), abort=abort)
    with small() as bench:
        assert bench.modulator.modulation is None
        checkpoint = Checkpoint(second, first)
        resumed = run_procedure(calibrate_with_method(bench, "docrime", frames=FRAMES, checkpoint=checkpoint))
    assert not resumed.partial
    assert resumed.frames + resumed.lost_frames == FRAMES
    assert resumed.grid.modulation == pytest.approx(3, rel=0.01)
