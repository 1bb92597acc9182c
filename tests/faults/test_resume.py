"""Interrupted and resumed: statistically the same result; states that do not fit are refused."""

from __future__ import annotations

import logging
import threading
from dataclasses import replace

import numpy as np
import pytest
from small_bench import assert_flat, small

from escape_hw.api.procedure import run as run_procedure
from escape_hw.calibration.acquisition.checkpoint import Checkpoint
from escape_hw.errors import Aborted, IncompatibleProduct, ProductError, StorageError
from escape_hw.io.fits.run_state import load_state, save_state
from escape_hw.runtime.procedures.calibration import calibrate_with_method

#: States now and then; the last is that of the moment it was interrupted.
OFTEN = ("twin.loss_probability=0.002", "calibration.checkpoint_s=0.2")
#: Method, options, and the stage and the share of it after which the run is interrupted.
CASES = {
    "docrime": ("docrime", {"frames": 1500}, "DO-CRIME", 0.6),
    "docrime, first frames": ("docrime", {"frames": 1500}, "DO-CRIME", 0.3),
    "docrime, closed loop": ("docrime", {"frames": 1500, "poke": 0.01}, "DO-CRIME in closed loop", 0.6),
    "push-pull-fast": ("push-pull-fast", {"frames": 3000}, "fast push-pull", 0.5),
    "modulated": ("modulated", {"frames": 200}, "modulation", 0.6),
    "push-pull": ("push-pull", {"frames": 10}, "push-pull", 0.5),
}


def measure(good, name, path, *, resume=None, stop=True, more=()):
    """Run a case, interrupted in the middle if asked."""
    method, options, stage, share = CASES[name]
    closed_loop = good.run.result if "closed" in name else None
    abort = threading.Event()

    def watch(progress):
        if stop and progress.stage == stage and progress.fraction > share:
            abort.set()

    with small(*OFTEN, *more) as bench:
        checkpoint = Checkpoint(path, resume)
        procedure = calibrate_with_method(
            bench, method, grid=good.grid, closed_loop=closed_loop, checkpoint=checkpoint, **options
        )
        try:
            return run_procedure(procedure, observers=(watch,), abort=abort)
        finally:
            assert_flat(bench)


#: The other cases share the code of these. Fast push-pull is DO-CRIME with other pokes.
QUICK = ("push-pull", "docrime")
EVERY = [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in CASES]


@pytest.mark.parametrize("name", EVERY)
def test_interrupted_and_resumed_it_equals_the_uninterrupted_run(good, tmp_path, monkeypatch, name):
    # Progress at every frame, so that a run of a fifth of a second can be interrupted in its middle.
    monkeypatch.setattr("escape_hw.api.procedure.Reporter.PERIOD_S", 0.0)
    path = tmp_path / "run.state"
    with pytest.raises(Aborted) as caught:
        measure(good, name, path)
    state = load_state(path)
    resumed = measure(good, name, tmp_path / "more.state", resume=path, stop=False)
    whole = measure(good, name, tmp_path / "whole.state", stop=False)
    assert not resumed.partial
    assert resumed.matrix.n_modes == whole.matrix.n_modes
    if name.startswith("docrime") or name == "push-pull-fast":
        assert resumed.frames == whole.frames == CASES[name][1]["frames"]
    if caught.value.partial is not None and "first" not in name:
        assert caught.value.partial.frames < resumed.frames
    assert state.grid is not None
    # Equal in statistics: errors of the same size, and no further apart than these say.
    size = np.median(resumed.matrix.sigma / whole.matrix.sigma)
    assert size == pytest.approx(1, abs=0.15)
    errors = (resumed.matrix.data - whole.matrix.data) / np.hypot(resumed.matrix.sigma, whole.matrix.sigma)
    # On a source, vibration is common to the frames of a push, and the scatter understates it.
    assert np.mean(np.square(errors)) < (6 if name == "push-pull" else 1.6)
    gain = np.vdot(resumed.matrix.data, whole.matrix.data) / np.vdot(whole.matrix.data, whole.matrix.data)
    assert gain == pytest.approx(1, abs=0.05)
    assert resumed.grid.motion_px == pytest.approx(whole.grid.motion_px, rel=0.2)


@pytest.mark.parametrize("stop", [False, True])
def test_a_state_that_cannot_be_saved_is_logged_once_and_the_run_goes_on(
    good, tmp_path, monkeypatch, caplog, stop
):
    path, full = tmp_path / "run.state", StorageError("the disk is full")

    def fail_after_the_first(*arguments):
        if path.exists():
            raise full
        return save_state(*arguments)

    monkeypatch.setattr("escape_hw.calibration.acquisition.checkpoint.save_state", fail_after_the_first)
    monkeypatch.setattr("escape_hw.api.procedure.Reporter.PERIOD_S", 0.0)
    often = ("calibration.checkpoint_s=0.01",)
    if stop:
        with pytest.raises(Aborted) as caught:
            measure(good, "push-pull", path, more=often)
        assert caught.value.partial.partial
    else:
        assert not measure(good, "push-pull", path, stop=False, more=often).partial
    (warning,) = [one for one in caplog.records if one.levelno == logging.WARNING]
    assert "the run goes on: the disk is full" in warning.getMessage()
    assert load_state(path).values["request"] == {}


@pytest.fixture(scope="module")
def kept(good, tmp_path_factory):
    """The state of a run that was interrupted."""
    path = tmp_path_factory.mktemp("kept") / "run.state"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("escape_hw.api.procedure.Reporter.PERIOD_S", 0.0)
        with pytest.raises(Aborted):
            measure(good, "docrime", path)
    return path


@pytest.mark.parametrize(
    ("more", "options", "match"),
    [
        (("loop.gain=0.31",), {}, r"its configuration differs from this run's in loop\.gain;"),
        (("basis.n_modes=20", "calibration.sprint_modes=10"), {}, r"in basis\.n_modes"),
        ((), {"poke": 0.01}, "its poke is 0.02, this run's is 0.01"),
        ((), {"whiten": False}, "its whiten is True, this run's is False"),
    ],
)
def test_what_does_not_fit_is_refused_before_anything_moves(kept, tmp_path, more, options, match):
    with small(*OFTEN, *more) as bench:
        before = bench.dm.sent_count
        checkpoint = Checkpoint(tmp_path / "new.state", kept)
        with pytest.raises(IncompatibleProduct, match=match):
            run_procedure(
                calibrate_with_method(bench, "docrime", frames=3000, checkpoint=checkpoint, **options)
            )
        assert bench.dm.sent_count == before


def test_another_method_or_loop_is_refused(good, kept, tmp_path):
    closed_loop = good.run.result
    with small(*OFTEN) as bench:
        for options in ({"method": "push-pull-fast"}, {"method": "docrime", "closed_loop": closed_loop}):
            checkpoint = Checkpoint(tmp_path / "new.state", kept)
            with pytest.raises(IncompatibleProduct, match="its method is 'docrime'"):
                run_procedure(calibrate_with_method(bench, frames=3000, checkpoint=checkpoint, **options))


def test_another_matrix_in_the_loop_is_refused(good, tmp_path, monkeypatch):
    monkeypatch.setattr("escape_hw.api.procedure.Reporter.PERIOD_S", 0.0)
    path = tmp_path / "run.state"
    with pytest.raises(Aborted):
        measure(good, "docrime, closed loop", path)
    scaled = replace(good.matrix, data=good.matrix.data * np.float32(1.1))
    closed_loop = replace(good.run.result, matrix=scaled)
    checkpoint = Checkpoint(tmp_path / "new.state", path)
    with small(*OFTEN) as bench:
        procedure = calibrate_with_method(
            bench, "docrime", frames=3000, poke=0.01, closed_loop=closed_loop, checkpoint=checkpoint
        )
        with pytest.raises(IncompatibleProduct, match="its control matrix is"):
            run_procedure(procedure)


def test_a_damaged_state_is_refused(kept, tmp_path):
    content = bytearray(kept.read_bytes())
    content[len(content) // 2] ^= 1
    damaged = tmp_path / "damaged.state"
    damaged.write_bytes(content)
    checkpoint = Checkpoint(tmp_path / "new.state", damaged)
    with small(*OFTEN) as bench:
        procedure = calibrate_with_method(bench, "docrime", frames=3000, checkpoint=checkpoint)
        with pytest.raises(ProductError, match="damaged"):
            run_procedure(procedure)
