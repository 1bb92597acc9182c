"""The registration from a tenth of a second of a running loop: correct over seeds, or refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2
from small_bench import INJECTED, assert_flat, small

from escape_hw.calibration.escape.method import escape
from escape_hw.errors import Aborted, CalibrationError, TooFewFrames

SEEDS = [range(1), pytest.param(range(4), marks=pytest.mark.slow)]
#: Fewer than a matrix of 30 modes takes (82).
FRAMES = 50


def measured(closed_loop, *more, seed=1, frames=FRAMES, poke=0.02, **options):
    # Another mirror, turbulence and pokes for each seed: their errors are in common otherwise.
    with small(*more, seed=seed) as bench:
        try:
            return bench.run(escape(bench, frames=frames, poke=poke, closed_loop=closed_loop, **options))
        finally:
            assert_flat(bench)


@pytest.fixture(scope="module")
def closed_loop(good):
    return good.run.result


def pull(found) -> np.ndarray:
    return (found.registration.registration.to_array() - INJECTED) / found.registration.sigma


@pytest.mark.slow
@pytest.mark.parametrize("seeds", SEEDS, ids=["one", "four"])
@pytest.mark.parametrize(
    "name",
    [
        pytest.param("undisturbed", marks=pytest.mark.slow),
        "lost frames",
        pytest.param("vibration", marks=pytest.mark.slow),
        pytest.param("a matrix half as large", marks=pytest.mark.slow),
        pytest.param("commands cut by the limits", marks=pytest.mark.slow),
    ],
)
def test_right_within_its_errors_whatever_the_loop_does(closed_loop, name, seeds):
    more = {
        "lost frames": ["twin.loss_probability=0.03"],
        "vibration": ["twin.vibration.amplitude_rad=[6e-5]", "twin.vibration.frequency_hz=[31.0]"],
        "commands cut by the limits": ["devices.dm.limits.max_stroke=0.2"],
    }.get(name, [])
    if name == "a matrix half as large":
        closed_loop = replace(
            closed_loop, matrix=replace(closed_loop.matrix, data=closed_loop.matrix.data / 2)
        )
    pulls = []
    for seed in seeds:
        found = measured(closed_loop, *more, seed=seed)
        assert found.registration.converged, found.registration.warnings
        assert found.measured is None
        assert found.matrix.metrics["frames"] == FRAMES
        if name == "commands cut by the limits":
            assert found.matrix.metrics["clipped_pokes"] > 0
            assert any("limits shortened" in note for note in found.notes)
        elif name != "a matrix half as large":
            # That one doubles the loop's gain, whose commands may reach the limits, too.
            assert found.matrix.metrics["clipped_pokes"] == 0
        pulls.append(pull(found))
    assert np.abs(pulls).max() < 5
    # Exceeded by chance once in a thousand.
    assert np.sum(np.square(pulls)) < chi2.ppf(0.999, np.size(pulls))


@pytest.mark.slow
def test_smaller_pokes_and_more_frames_give_larger_errors_and_smaller_ones(closed_loop):
    strong, weak = measured(closed_loop), measured(closed_loop, poke=0.002)
    # Those between runs: the unequal actuators, in both alike, are most of the others.
    errors = [one.registration.repeatability_sigma for one in (weak, strong)]
    assert errors[0] is not None
    assert errors[1] is not None
    assert (errors[0][:3] > 1.3 * errors[1][:3]).all()
    assert np.abs(pull(weak)).max() < 5


def test_it_is_the_answer_of_the_frames_and_not_of_the_matrix_that_closes_the_loop(closed_loop, good):
    """A control matrix for a mirror of another registration: the result is the same."""
    from escape_hw.api.registration import Registration
    from escape_hw.calibration.modes.derivatives import modal_matrix

    moved = INJECTED + np.array([15.0, -15.0, 0.3, 0.5, -0.5])
    m2c = closed_loop.matrix.m2c
    gain = np.linalg.norm(closed_loop.matrix.data) / np.linalg.norm(
        modal_matrix(good.model, Registration.from_array(INJECTED), m2c)
    )
    wrong = gain * modal_matrix(good.model, Registration.from_array(moved), m2c)
    found = measured(replace(closed_loop, matrix=replace(closed_loop.matrix, data=wrong.astype(np.float32))))
    assert np.abs(pull(found)).max() < 4.5


def test_what_is_refused_and_what_ends_it(closed_loop):
    with small() as bench:
        with pytest.raises(TooFewFrames, match="at least 13 frames"):
            bench.run(escape(bench, frames=12, closed_loop=closed_loop))
        assert bench.dm.sent_count == 0
    with pytest.raises(CalibrationError, match="diverged"):
        measured(
            replace(closed_loop, matrix=replace(closed_loop.matrix, data=-closed_loop.matrix.data)), frames=80
        )
    with small() as bench:
        running = escape(bench, frames=60, closed_loop=closed_loop)
        for _ in range(3):
            next(running)
        with pytest.raises(Aborted, match="too few for a registration"):
            running.throw(Aborted("stop"))
        assert_flat(bench)
