"""Targets and checkpoints of runs too short for a measured matrix are used or refused, never ignored."""

from __future__ import annotations

import pytest
from small_bench import small

from escape_hw.calibration.acquisition.checkpoint import Checkpoint
from escape_hw.calibration.acquisition.stopping import Target
from escape_hw.calibration.escape.method import escape
from escape_hw.errors import ConfigError

#: Fewer than a matrix of 30 modes takes (82).
FRAMES = 50


@pytest.fixture(params=["open loop", "closed loop"])
def loop(request, good):
    return {"closed_loop": good.run.result if request.param == "closed loop" else None}


def test_a_checkpoint_is_refused_before_anything_moves(loop, tmp_path):
    with small() as bench:
        with pytest.raises(ConfigError, match=r"cannot be resumed.*at least 82 frames"):
            bench.run(escape(bench, frames=FRAMES, checkpoint=Checkpoint(tmp_path / "state.fits"), **loop))
        assert bench.dm.sent_count == 0


def test_a_signal_to_noise_ratio_is_refused_before_anything_moves(loop):
    with small() as bench:
        with pytest.raises(ConfigError, match=r"no signal-to-noise ratio.*at least 82 frames"):
            bench.run(escape(bench, frames=FRAMES, until=Target(snr=5.0), **loop))
        assert bench.dm.sent_count == 0


@pytest.mark.parametrize(
    ("accuracy", "text"),
    [pytest.param(50.0, "(reached)", marks=pytest.mark.slow), (1e-3, "(not reached; use more frames)")],
)
@pytest.mark.parametrize(
    "loop", ["open loop", pytest.param("closed loop", marks=pytest.mark.slow)], indirect=True
)
def test_a_note_states_whether_the_accuracy_was_reached(loop, accuracy, text):
    with small() as bench:
        result = bench.run(escape(bench, frames=FRAMES, until=Target(accuracy=accuracy), **loop))
    assert result.notes[-1].endswith(text)


def test_the_former_keywords_warn(good, tmp_path):
    with (
        small() as bench,
        pytest.warns(DeprecationWarning, match=r"escape\(keep=\) is called escape\(checkpoint=\)"),
        pytest.raises(ConfigError, match="cannot be resumed"),
    ):
        bench.run(escape(bench, frames=FRAMES, keep=Checkpoint(tmp_path / "state.fits")))
