"""Stopped in the middle of each procedure: flat within a second, measured data saved."""

from __future__ import annotations

import signal
import threading
import time
from functools import partial

import numpy as np
import pytest
from small_bench import assert_flat, small

from escape_hw.api.procedure import Progress
from escape_hw.calibration.acquisition.model_psf import measure_model_psf
from escape_hw.calibration.acquisition.sensor_setup import find_sensor, measure_dark
from escape_hw.calibration.docrime.open_loop import docrime
from escape_hw.calibration.escape.method import escape
from escape_hw.calibration.loop.gain_search import find_best_gain
from escape_hw.calibration.loop.performance import close_loop
from escape_hw.calibration.push_pull.procedure import push_pull
from escape_hw.errors import Aborted
from escape_hw.paper.experiments import reproduce_shwfs, reproduce_table1
from escape_hw.paper.paired_seeds import reproduce_revolt
from escape_hw.runtime.procedures.model_psf import model_psf
from escape_hw.runtime.session.record import without_turbulence

reproduce = partial(reproduce_shwfs, loop_frames=5000)


def calm(bench, procedure):
    with without_turbulence(bench):
        return (yield from procedure)


#: Procedure, stage to stop it in, and share of the stage to wait for.
PLACES = {
    "grid": (lambda b, g: find_sensor(b, frames=5000), "find the lenslet grid", 0.01),
    "dark frame": (lambda b, g: measure_dark(b, frames=5000), "dark frame", 0.01),
    "push-pull, grid": (lambda b, g: calm(b, push_pull(b)), "find the lenslet grid", 0.0),
    "push-pull, test step": (lambda b, g: calm(b, push_pull(b, grid=g.grid)), "test step", 0.0),
    "push-pull": (lambda b, g: calm(b, push_pull(b, frames=50)), "push-pull", 0.3),
    "push-pull, long mode": (lambda b, g: calm(b, push_pull(b, frames=50_000)), "push-pull", 0.0001),
    "DO-CRIME": (lambda b, g: docrime(b, frames=100_000), "DO-CRIME", 0.006),
    "DO-CRIME, past the burn-in": (lambda b, g: docrime(b, frames=100_000), "DO-CRIME", 0.02),
    "DO-CRIME, at once": (lambda b, g: docrime(b, frames=100_000), "DO-CRIME", 0.0),
    "ESCAPE, DO-CRIME": (lambda b, g: escape(b, frames=100_000), "DO-CRIME", 0.006),
    "ESCAPE, model": (lambda b, g: escape(b, frames=400), "synthetic model", 0.0),
    "ESCAPE, SPRINT": (lambda b, g: escape(b, frames=400), "SPRINT", 0.05),
    "model PSF": (lambda b, g: model_psf(b, frames=500), "model PSF", 0.01),
    "best gain": (lambda b, g: find_best_gain(b, g.matrix, g.grid, frames=50_000), "loop at gain", 0.006),
    "closed loop": (lambda b, g: close_loop(b, g.matrix, g.grid, frames=100_000), "closed loop", 0.003),
    "closed loop with Strehl": (
        lambda b, g: close_loop(b, g.matrix, g.grid, frames=100_000, model_psf=g.psf),
        "closed loop",
        0.004,
    ),
    "reproduce, push-pull": (lambda b, g: reproduce(b, frames=400), "push-pull", 0.3),
    "reproduce, DO-CRIME": (lambda b, g: reproduce(b, frames=50_000), "DO-CRIME", 0.01),
    "reproduce, model PSF": (lambda b, g: reproduce(b, frames=400), "model PSF", 0.0),
    "reproduce, best gain": (lambda b, g: reproduce(b, frames=400), "loop at gain", 0.2),
    "reproduce, paired loops": (lambda b, g: reproduce_revolt(b, short=400, long=400), "loop at gain", 0.2),
    "table 1": (lambda b, g: reproduce_table1(b, frames={"SHORT": 400, "LONG": 99_999}), "DO-CRIME", 0.006),
}
#: In the quick suite, parts of what is reproduced are stopped alone, and DO-CRIME once in its stage.
SLOW = (
    "reproduce, DO-CRIME", "reproduce, model PSF", "reproduce, best gain", "reproduce, paired loops",
    "DO-CRIME, past the burn-in",
)  # fmt: skip
#: Where nothing is measured yet that could be kept.
EMPTY = {
    "grid", "dark frame", "push-pull, grid", "push-pull, test step", "push-pull, long mode",
    "DO-CRIME, at once", "model PSF",
}  # fmt: skip


class StopThere:
    """Sets ``abort`` when a stage has come so far; remembers when."""

    def __init__(self, stage: str, share: float) -> None:
        self.abort = threading.Event()
        self.stage, self.share, self.at = stage, share, 0.0
        self.seen: list[str] = []

    def __call__(self, progress: Progress) -> None:
        self.seen.append(progress.stage)
        if progress.stage.startswith(self.stage) and progress.fraction >= self.share and not self.at:
            self.at = time.monotonic()
            self.abort.set()


@pytest.mark.parametrize(
    "place", [pytest.param(place, marks=pytest.mark.slow if place in SLOW else ()) for place in PLACES]
)
def test_stopped_in(good, place):
    procedure, stage, share = PLACES[place]
    stop = StopThere(stage, share)
    with small() as bench:
        with pytest.raises(Aborted) as caught:
            bench.run(procedure(bench, good), observers=(stop,), abort=stop.abort)
        took = time.monotonic() - stop.at
        assert stop.at, f"never came so far: {sorted(set(stop.seen))}"
        assert took < 1.0
        assert_flat(bench)
        assert bench.screen.state.inserted
        assert not bench.screen.state.blocked
        assert bench.science is not None
        assert not bench.science.is_running
    partial = caught.value.partial
    assert (partial is None) == (place in EMPTY)
    if partial is not None and place != "best gain":
        assert partial.partial is True


def test_a_partial_push_pull_holds_the_modes_that_were_reached(good):
    stop = StopThere("push-pull", 0.3)
    with small() as bench, pytest.raises(Aborted) as caught:
        bench.run(calm(bench, push_pull(bench, frames=50)), observers=(stop,), abort=stop.abort)
    matrix = caught.value.partial.matrix
    assert 5 <= matrix.n_modes < 30
    correlation = [
        np.corrcoef(matrix.data[:, k], good.matrix.data[:, k])[0, 1] for k in range(matrix.n_modes)
    ]
    assert min(correlation) > 0.95


@pytest.mark.parametrize("place", ["DO-CRIME", "ESCAPE, DO-CRIME", "ESCAPE, model", "ESCAPE, SPRINT"])
def test_a_partial_docrime_is_a_good_matrix_with_correct_errors(good, place):
    procedure, stage, share = PLACES[place]
    stop = StopThere(stage, share)
    with small("twin.loss_probability=0") as bench, pytest.raises(Aborted) as caught:
        bench.run(procedure(bench, good), observers=(stop,), abort=stop.abort)
    partial = caught.value.partial
    assert partial.registration is None
    assert partial.matrix.method == "docrime-whitened"
    assert partial.frames >= 400
    np.testing.assert_array_equal(partial.grid.valid, good.grid.valid)
    pulls = (partial.matrix.data - good.matrix.data) / np.hypot(partial.matrix.sigma, good.matrix.sigma)
    # The grid of this run is not that of the other: their windows differ by a fraction of a pixel.
    assert np.mean(np.square(pulls)) < 4


@pytest.mark.slow
def test_a_reproduction_saves_the_finished_parts(good):
    stop = StopThere("loop at gain", 0.2)
    with small() as bench, pytest.raises(Aborted) as caught:
        bench.run(reproduce(bench, frames=400), observers=(stop,), abort=stop.abort)
    partial = caught.value.partial
    assert list(partial.calibrations) == ["push-pull", "DO-CRIME", "ESCAPE"]
    assert not any(calibration.partial for calibration in partial.calibrations.values())
    assert partial.scans["push-pull"][-1].partial
    assert not partial.loops


@pytest.mark.slow
def test_stopped_in_push_pull_a_reproduction_keeps_the_other_matrices(good):
    stop = StopThere("push-pull", 0.0)
    with small() as bench, pytest.raises(Aborted) as caught:
        bench.run(reproduce(bench, frames=400), observers=(stop,), abort=stop.abort)
    calibrations = caught.value.partial.calibrations
    assert list(calibrations)[-2:] == ["DO-CRIME", "ESCAPE"]
    assert not calibrations["ESCAPE"].partial


@pytest.mark.slow
def test_all_matrices_of_a_reproduction_share_lenslets_and_references(good):
    stop = StopThere("model PSF", 0.0)
    with small() as bench, pytest.raises(Aborted) as caught:
        bench.run(reproduce(bench, frames=400), observers=(stop,), abort=stop.abort)
    ours, *others = (one.grid for one in caught.value.partial.calibrations.values())
    assert len(others) == 2
    for other in others:
        np.testing.assert_array_equal(other.references_px, ours.references_px)
        assert (other.origin_px, other.pitch_px) == (ours.origin_px, ours.pitch_px)


@pytest.mark.slow
def test_stopped_before_sprint_a_reproduction_keeps_no_escape_matrix(good):
    stop = StopThere("DO-CRIME", 0.01)
    with small() as bench, pytest.raises(Aborted) as caught:
        bench.run(reproduce(bench, frames=50_000), observers=(stop,), abort=stop.abort)
    assert list(caught.value.partial.calibrations) == ["DO-CRIME"]
    assert caught.value.partial.calibrations["DO-CRIME"].partial


@pytest.fixture
def default_interrupts():
    """Python's handler of SIGINT, which a program started in the background does not have."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_ctrl_c_in_a_script(good, default_interrupts):
    """Without any handler of our own: the runner turns SIGINT into an orderly stop."""

    presses: list[int] = []

    def press(progress: Progress) -> None:
        # Once: the second Ctrl-C would end the program at once.
        if progress.done > 300 and not presses:
            presses.append(progress.done)
            signal.raise_signal(signal.SIGINT)

    with small() as bench:
        with pytest.raises(Aborted, match="interrupted by Ctrl-C") as caught:
            bench.run(docrime(bench, frames=100_000), observers=(press,))
        assert_flat(bench)
    assert caught.value.partial.partial


def test_a_loop_stopped_and_started_again(good):
    stop = StopThere("closed loop", 0.003)
    with small() as bench:
        with pytest.raises(Aborted):
            bench.run(
                close_loop(bench, good.matrix, good.grid, frames=100_000),
                observers=(stop,),
                abort=stop.abort,
            )
        result = bench.run(close_loop(bench, good.matrix, good.grid, frames=300))
        assert result.stable
        assert result.frames == 300
        assert_flat(bench)


def test_measure_model_psf_stops_the_science_camera_when_closed_early():
    with small() as bench:
        running = measure_model_psf(bench, frames=1000)
        next(running)
        running.close()
        assert not bench.science.is_running
