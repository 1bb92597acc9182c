"""Hardly enough frames: large but correct errors, or a refusal."""

from __future__ import annotations

import math

import numpy as np
import pytest
from small_bench import INJECTED, assert_flat, small

from escape_hw.calibration.docrime.open_loop import docrime_run
from escape_hw.calibration.sprint.fit import sprint
from escape_hw.errors import TooFewFrames
from escape_hw.paper.experiments import reproduce_shwfs

#: Fewest frames that 30 modes with a filter of 6 and 5 lags may start with, and a few more.
JUST_ENOUGH = (82, 130)
RUNS = 4


@pytest.fixture(scope="module")
def short_runs(good):
    """A few runs of each length, plain and whitened, on one bench."""
    with small("twin.loss_probability=0") as bench:
        return {
            (n, whiten): [
                bench.run(docrime_run(bench, frames=n, grid=good.grid, whiten=whiten)) for _ in range(RUNS)
            ]
            for n in JUST_ENOUGH
            for whiten in (True, False)
        }


@pytest.mark.parametrize("whiten", [True, False])
@pytest.mark.parametrize("frames", JUST_ENOUGH)
def test_stated_errors_against_the_truth(good, short_runs, frames, whiten):
    chi2, gains = [], []
    for run in short_runs[frames, whiten]:
        matrix = run.result.matrix
        assert np.isfinite(matrix.data).all()
        assert (matrix.sigma > 0).all()
        gain = float(np.vdot(matrix.data, good.matrix.data) / np.vdot(good.matrix.data, good.matrix.data))
        # The response is scaled to sum 1 and comes from few frames: it has an error common to all elements.
        errors = (matrix.data / gain - good.matrix.data) / np.hypot(matrix.sigma, good.matrix.sigma)
        chi2.append(np.mean(np.square(errors)))
        gains.append(gain)
    assert 0.5 < np.mean(chi2) < 2
    # It scatters by 12 % over twelve runs of 82 frames; by 8 % on a mirror with Gaussian influence functions.
    assert np.abs(np.array(gains) - 1).max() < (0.3 if whiten else 0.5)


def test_errors_grow_towards_the_limit(short_runs):
    sizes = [np.median([run.result.matrix.sigma for run in short_runs[n, True]]) for n in JUST_ENOUGH]
    assert sizes == sorted(sizes, reverse=True)
    assert sizes[0] > 1.3 * sizes[-1]


@pytest.mark.parametrize("frames", JUST_ENOUGH)
def test_the_registration_is_right_within_its_errors_or_reports_that_it_is_not(good, short_runs, frames):
    pulls = []
    for run in short_runs[frames, True][: RUNS // 2]:
        estimate = sprint(run.result.matrix, good.model, modes=20, covariance=run.solution.covariance)
        if estimate.converged:
            pulls.append((estimate.registration.to_array() - INJECTED) / estimate.sigma)
        else:
            assert estimate.warnings
    assert pulls
    assert np.abs(pulls).max() < 5
    # A matrix from the minimum number of frames is biased to smaller scalings, by two of its errors or so.
    assert np.mean(np.square(pulls)) < 4.5


@pytest.mark.slow
def test_the_full_bench_at_its_limit():
    from escape_hw.runtime.session.system import open_system

    with open_system("razor-shwfs") as bench:
        with pytest.raises(TooFewFrames, match=r"209 frames cannot constrain 94 modes.* at least 210"):
            bench.run(docrime_run(bench, frames=209))
        assert bench.dm.sent_count == 0
        run = bench.run(docrime_run(bench, frames=215))
        estimate = sprint(
            run.result.matrix, bench.model(run.result.grid), modes=50, covariance=run.solution.covariance
        )
    assert estimate.converged, estimate.warnings
    pulls = (estimate.registration.to_array() - INJECTED) / estimate.sigma
    assert np.abs(pulls).max() < 4


def test_loss_that_leaves_too_few_complete_frames_is_an_error():
    """Enough frames were requested, but half of them got lost: refused with the number needed."""
    with small("twin.loss_probability=0.5") as bench:
        with pytest.raises(TooFewFrames, match=r"complete frames cannot constrain 30 modes; at least \d+"):
            bench.run(docrime_run(bench, frames=100))
        assert not bench.dm.shape.any()


def test_a_reproduction_with_too_few_frames_is_refused_before_its_baseline(bench):
    frame = bench.wfs.next_frame(1.0).index
    with pytest.raises(TooFewFrames, match="50 frames cannot constrain 30 modes"):
        bench.run(reproduce_shwfs(bench, frames=50, loop_frames=5000))
    assert bench.wfs.next_frame(1.0).index <= frame + 2
    assert_flat(bench)


def test_a_loop_too_short_for_its_strehl_ratio_states_how_long_it_must_be(good, shared):
    def run(frames):
        return shared.close_loop(good.matrix, good.grid, frames=frames, model_psf=good.psf)

    nothing, little, enough = run(100), run(220), run(270)
    assert nothing.strehl is None
    assert "too short for Strehl ratios: 0 frames" in nothing.notes[0]
    assert "at least 270 frames" in nothing.notes[0]
    assert math.isnan(little.strehl.peak.sigma)
    assert "too short for an error of the Strehl ratios" in little.notes[0]
    assert math.isfinite(enough.strehl.peak.sigma)
    assert not enough.notes
