"""Lost frames remove pairs and shift none: the same matrix within its errors, the same registration."""

from __future__ import annotations

from functools import cache
from itertools import count, pairwise

import numpy as np
import pytest
from small_bench import INJECTED, assert_flat, faulty, small

from escape_hw.calibration.docrime.estimator import DocrimeEstimator
from escape_hw.calibration.docrime.open_loop import docrime_run
from escape_hw.calibration.loop.performance import close_loop
from escape_hw.calibration.push_pull.procedure import push_pull
from escape_hw.calibration.sprint.fit import sprint

FRAMES = 800


def compare(run, good):
    """Mean square of the normalised errors, and the common gain, against the long run without loss."""
    matrix = run.result.matrix
    errors = matrix.data - good.matrix.data
    chi2 = float(np.mean(np.square(errors / np.hypot(matrix.sigma, good.matrix.sigma))))
    gain = float(np.vdot(matrix.data, good.matrix.data) / np.vdot(good.matrix.data, good.matrix.data))
    return chi2, gain


def measure(good, loss, seed):
    with small(f"twin.loss_probability={loss}") as bench:
        bench.rng = np.random.default_rng(seed)
        return bench.run(docrime_run(bench, frames=FRAMES, grid=good.grid))


@pytest.fixture(scope="module")
def runs(good):
    """Two runs for a rate of loss, made when they are asked for."""
    return cache(lambda loss: [measure(good, loss, seed) for seed in (3, 4)])


LOSSES = pytest.mark.parametrize("loss", [pytest.param(0.01, marks=pytest.mark.slow), 0.1])


@pytest.mark.slow
@LOSSES
def test_the_same_matrix_within_its_noise(good, runs, loss):
    for run in runs(loss):
        assert run.result.frames == FRAMES
        expected = FRAMES * loss / (1 - loss)
        assert abs(run.result.lost_frames - expected) < 5 * np.sqrt(expected) + 1
        assert run.result.sky_seconds == pytest.approx((FRAMES + run.result.lost_frames) / 500, abs=0.01)
        chi2, gain = compare(run, good)
        without = np.mean([compare(other, good)[0] for other in runs(0.0)])
        # Errors of the same mode go together from slope to slope, so chi-squared scatters more than its name.
        assert chi2 == pytest.approx(without, abs=0.3)
        assert chi2 == pytest.approx(1, abs=0.45)
        assert gain == pytest.approx(1, abs=0.02)
        delay = runs(0.0)[0].result.response.delay_frames
        assert run.result.response.delay_frames == pytest.approx(delay, abs=0.02)


def median_error(found):
    return np.median([run.result.matrix.sigma for run in found])


def test_what_is_lost_shows_in_the_errors(runs):
    """Losing a tenth of the frames interrupts most histories of the filter, which sigma includes."""
    without, with_loss = (median_error(runs(loss)) for loss in (0.0, 0.1))
    assert without < with_loss < 2 * without


@pytest.mark.slow
def test_a_hundredth_hardly_shows_in_the_errors(runs):
    assert median_error(runs(0.01)) == pytest.approx(median_error(runs(0.0)), rel=0.1)


@LOSSES
def test_the_same_registration(good, runs, loss):
    for run in runs(loss):
        estimate = sprint(run.result.matrix, good.model, modes=20, covariance=run.solution.covariance)
        assert estimate.converged, estimate.warnings
        pulls = (estimate.registration.to_array() - INJECTED) / estimate.sigma
        assert np.abs(pulls).max() < 4
        assert (estimate.sigma < [1, 1, 0.05, 0.3, 0.3]).all()


def test_overlooked_losses_would_be_seen(good, runs, monkeypatch):
    """The tests above can fail: frames counted on arrival instead of by the camera spoil everything."""
    # Before frames are counted wrongly: the other tests use it as well.
    right = runs(0.1)[0].result
    real, arrived = DocrimeEstimator.partial_fit, count()
    monkeypatch.setattr(
        DocrimeEstimator, "partial_fit", lambda self, index, *rest: real(self, next(arrived), *rest)
    )
    run = measure(good, 0.1, 3)
    assert np.median(run.result.matrix.sigma) > 2 * np.median(right.matrix.sigma)
    assert abs(run.result.response.delay_frames - right.response.delay_frames) > 0.02


def test_every_tenth_frame_lost_by_the_camera(good):
    with faulty("twin.loss_probability=0", wfs={"drop_every": 10}) as bench:
        run = bench.run(docrime_run(bench, frames=FRAMES, grid=good.grid))
        assert run.result.lost_frames == pytest.approx(FRAMES / 9, abs=2)
        assert_flat(bench)
    chi2, gain = compare(run, good)
    assert chi2 == pytest.approx(1, abs=0.45)
    assert gain == pytest.approx(1, abs=0.02)


@pytest.mark.slow
def test_push_pull_under_loss(good):
    found = []
    for loss in (0.0, 0.1):
        with small(f"twin.loss_probability={loss}") as bench:
            bench.screen.set(inserted=False)
            found.append(bench.run(push_pull(bench, frames=20, grid=good.grid)))
    calm, lossy = found
    assert lossy.lost_frames > 50
    errors = (lossy.matrix.data - calm.matrix.data) / np.hypot(lossy.matrix.sigma, calm.matrix.sigma)
    # Vibration is common to the frames of a push, so the scatter within it understates a little.
    assert np.mean(np.square(errors)) < 4
    assert np.linalg.norm(lossy.matrix.data - calm.matrix.data) < 0.1 * np.linalg.norm(calm.matrix.data)


def test_the_loop_survives_loss_and_counts_it(good):
    residual = []
    for loss in (0.0, 0.01, 0.1):
        with small(f"twin.loss_probability={loss}") as bench:
            result = bench.run(close_loop(bench, good.matrix, good.grid, frames=600))
            assert result.stable
            assert_flat(bench)
        assert abs(result.lost_frames - 600 * loss / (1 - loss)) < 5 * np.sqrt(600 * loss) + 1
        residual.append(result.residual_rms_nm)
    assert all(later < 1.5 * earlier for earlier, later in pairwise(residual))
