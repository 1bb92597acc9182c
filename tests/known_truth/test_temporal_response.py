"""The temporal response, and the gain of the matrix, where the first frames carry little information."""

from __future__ import annotations

import numpy as np
import pytest
import simulated_loop as simulated

from escape_hw.calibration.docrime.response import LagSums, ResponseEstimate

SEEDS = 16


@pytest.mark.slow
@pytest.mark.parametrize(
    "gain",
    [
        pytest.param(0.4, id="one", marks=pytest.mark.slow),
        pytest.param(np.linspace(0.05, 0.6, simulated.N_MODES), id="of each mode"),
    ],
)
def test_weak_first_frames_do_not_spoil_the_gain(gain):
    """Pokes so weak that the first thousand frames may miss the gain by any factor."""
    gains, stated, pulls = [], [], []
    for seed in range(SEEDS):
        run = simulated.loop(seed, frames=5000, poke=0.004, gain=gain)
        found = run.fit()
        size = np.square(run.truth).sum()
        own = np.sqrt(np.square(found.sigma * run.truth).sum()) / size
        gains.append(float(np.vdot(found.matrix, run.truth)) / size)
        stated.append(found.gain_sigma)
        pulls.append((gains[-1] - 1) / np.hypot(found.gain_sigma, own))
    assert max(stated) < 0.25
    assert np.std(gains) < 0.2
    assert abs(np.mean(gains) - 1) < 4 * np.std(gains) / np.sqrt(SEEDS)
    assert 0.4 < np.mean(np.square(pulls)) < 3


def regression(rng, frames, weights, noise):
    """Slopes that answer to correlated motions by weights, instruments being part of the motions."""
    poked = rng.standard_normal((frames, weights.size, 6)).astype(np.float32)
    common = rng.standard_normal((frames, 1, 6)).astype(np.float32)
    made = poked + common
    # The motions know the noise; the instruments do not.
    slopes = np.einsum("l,tls->ts", weights, made) + noise * (rng.standard_normal((frames, 6)) + common[:, 0])
    return slopes.astype(np.float32), made, poked


def test_instruments_and_their_errors():
    weights = np.array([0.1, 0.7, 0.2])
    pulls = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        # Two stretches of unequal noise, the second one's predictions twice as large.
        sums = LagSums(3).add(*regression(rng, 300, weights, 0.2))
        slopes, made, poked = regression(rng, 600, weights, 0.4)
        sums.merge(LagSums(3).add(slopes, 2 * made, poked))
        found = sums.response()
        assert found.weights.sum() == pytest.approx(1)
        np.testing.assert_allclose(found.covariance.sum(axis=0), 0, atol=1e-9)
        pulls.append((found.weights - weights) / found.response.sigma)
    assert np.abs(np.mean(pulls, axis=0)).max() < 4 / np.sqrt(60)
    assert np.mean(np.square(pulls)) == pytest.approx(1, abs=0.3)


def test_estimates_are_weighted_by_their_covariances():
    free = np.array([[1.0, -1.0, 0.0], [0.0, 1.0, -1.0]]).T
    good = ResponseEstimate(np.array([0.2, 0.6, 0.2]), free @ np.diag([1e-4, 4e-4]) @ free.T)
    poor = ResponseEstimate(np.array([0.9, -0.7, 0.8]), 99 * good.covariance)
    both = poor.combine_with(good)
    np.testing.assert_allclose(both.weights, 0.99 * good.weights + 0.01 * poor.weights, atol=1e-6)
    np.testing.assert_allclose(both.covariance, 0.99 * good.covariance, rtol=1e-4, atol=1e-10)
    np.testing.assert_allclose(good.combine_with(poor).weights, both.weights, atol=1e-6)
    assert both.weights.sum() == pytest.approx(1)
