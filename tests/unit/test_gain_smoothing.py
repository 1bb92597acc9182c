"""Smoothing of optical gains: the trend, and single modes weighted by their errors."""

from __future__ import annotations

import numpy as np
import pytest

from escape_hw.calibration.optical_gain.smoothing import smooth_over_modes

N = 60


def trials(scatter: float, noise: float, count: int = 12):
    """Pulls and errors of trend and best estimate."""
    rng, modes = np.random.default_rng(5), np.arange(N)
    rows = []
    for _ in range(count):
        trend = 0.6 - 0.15 * np.exp(-modes / 8)
        true = trend * (1 + scatter * rng.standard_normal(N))
        sigma = noise * rng.uniform(0.5, 1.5, N)
        found = smooth_over_modes(true + sigma * rng.standard_normal(N), sigma)
        rows.append(
            (found.trend - trend, found.trend_sigma, found.best - true, found.best_sigma, found.value - true)
        )
    return [np.array(column) for column in zip(*rows, strict=True)]


@pytest.mark.parametrize(("scatter", "noise"), [(0.0, 0.02), (0.0, 0.15), (0.04, 0.02), (0.04, 0.15)])
@pytest.mark.slow
def test_errors_are_correct_with_and_without_deviations(scatter, noise):
    trend, trend_sigma, best, best_sigma, _ = trials(scatter, noise)
    assert 0.4 < np.mean((trend / trend_sigma) ** 2) < 1.8
    assert 0.2 < np.mean((best / best_sigma) ** 2) < 1.5


@pytest.mark.slow
def test_smoothing_improves_noisy_gains_and_does_not_degrade_others():
    *_, best, _, raw = trials(0.0, 0.15)
    assert best.std() < 0.4 * raw.std()
    *_, best, _, raw = trials(0.1, 0.01)
    assert best.std() < 1.05 * raw.std()


def test_a_mode_that_was_not_measured_gets_the_trend_and_a_larger_error():
    rng = np.random.default_rng(6)
    sigma = np.full(N, 0.02)
    sigma[20] = np.inf
    value = 0.7 + 0.02 * rng.standard_normal(N)
    value[20] = np.nan
    found = smooth_over_modes(value, sigma, 0.005)
    assert found.best[20] == pytest.approx(0.7, abs=0.02)
    assert found.best_sigma[20] >= found.best_sigma[[19, 21]].max()
    assert found.common_sigma == 0.005


def test_few_modes_get_their_mean_as_trend():
    found = smooth_over_modes(np.array([0.5, 0.7, np.nan]), np.array([0.1, 0.1, np.inf]))
    np.testing.assert_allclose(found.trend, 0.6)
    np.testing.assert_allclose(found.best, [0.5, 0.7, 0.6])


def test_gains_without_errors_are_refused():
    with pytest.raises(ValueError, match="positive standard errors"):
        smooth_over_modes(np.ones(N), np.zeros(N))
    with pytest.raises(ValueError, match="positive standard errors"):
        smooth_over_modes(np.full(N, np.nan), np.ones(N))
