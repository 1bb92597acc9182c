"""Standard errors of correlated series against the known error."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from escape_hw.pipeline.statistics import MIN_SAMPLES, standard_error

SERIES = 400


def autoregressive(n: int, memory: float, seed: int) -> tuple[NDArray[np.float64], float]:
    """Many series ``(SERIES, n)`` of unit variance, and the standard error of their means."""
    white = np.random.default_rng(seed).standard_normal((n, SERIES))
    x = white.copy()
    for t in range(1, n):
        x[t] = memory * x[t - 1] + math.sqrt(1 - memory**2) * white[t]
    k = np.arange(1, n)
    return x.T, math.sqrt((1 + 2 * ((1 - k / n) * memory**k).sum()) / n)


@pytest.mark.parametrize(
    ("n", "memory", "low", "high"),
    [
        (20, 0.0, 0.95, 1.4),
        (100, 0.0, 0.95, 1.2),
        (85, 0.8, 0.9, 1.1),
        (200, 0.9, 0.9, 1.1),
        (3000, 0.95, 0.95, 1.05),
        # Four correlation times: no longer to be had from the series.
        (40, 0.9, 0.6, 1.0),
    ],
)
def test_stated_error_is_the_scatter_of_the_mean(n, memory, low, high):
    series, truth = autoregressive(n, memory, seed=n)
    stated = math.sqrt(np.mean([standard_error(x) ** 2 for x in series]))
    # The scatter of 400 means is known to 3.5 %: three of them are allowed between theory and sample.
    assert series.mean(axis=1).std() == pytest.approx(truth, rel=0.11)
    assert low < stated / truth < high


def test_batches_of_a_fifth_of_the_correlation_time_would_not_do():
    series, truth = autoregressive(85, 0.9, seed=5)
    batches = [np.std([part.mean() for part in np.array_split(x, 8)], ddof=1) / math.sqrt(8) for x in series]
    stated = math.sqrt(np.mean([standard_error(x) ** 2 for x in series]))
    assert math.sqrt(np.mean(np.square(batches))) < 0.8 * truth
    assert stated > 0.85 * truth


def test_anticorrelated_series_state_no_less_than_nothing():
    series = np.tile([1.0, -1.0], 50) + 0.01 * np.arange(100)
    assert standard_error(series) > 0


def test_too_few_values_have_no_error_and_equal_ones_none():
    assert math.isnan(standard_error(np.arange(MIN_SAMPLES - 1.0)))
    assert math.isfinite(standard_error(np.arange(float(MIN_SAMPLES))))
    assert standard_error(np.ones(50)) == 0.0
