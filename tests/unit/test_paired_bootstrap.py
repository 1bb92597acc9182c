"""Paired comparisons: coverage of the interval, and the conclusion derived from it."""

from __future__ import annotations

import numpy as np
import pytest

from escape_hw.pipeline.statistics import PairedComparison, compare_pairs, describe_comparison

REPEATS = 200


def injected(seed: int, n: int, difference: float, skewed: bool) -> tuple[np.ndarray, np.ndarray]:
    """Two arms on common turbulence that scatters far more than their difference does."""
    rng = np.random.default_rng(seed)
    turbulence = rng.normal(0.35, 0.05, n)
    scatter = rng.exponential(0.008, n) - 0.008 if skewed else rng.normal(0, 0.008, n)
    return turbulence + difference + scatter, turbulence


@pytest.mark.parametrize("skewed", [False, True])
@pytest.mark.parametrize("n", [12, 24])
@pytest.mark.slow
def test_the_interval_holds_the_truth_as_often_as_it_says(n, skewed):
    inside = margin = 0
    for seed in range(REPEATS):
        found = compare_pairs(*injected(seed, n, 0.006, skewed), seed=seed)
        inside += found.low <= 0.006 <= found.high
        margin += found.equivalence < 0.006
    # 200 draws of a probability of 0.95 scatter by 1.5 %; three of that, and what skewness costs.
    assert 0.89 <= inside / REPEATS <= 0.995
    # Declaring equivalence within less than the true difference errs in one case out of twenty.
    assert margin / REPEATS <= 0.05 + 3 * 0.0154 + 0.02


def test_pairs_resolve_differences_below_the_scatter_due_to_turbulence():
    first, second = injected(3, 24, 0.02, False)
    assert compare_pairs(first, second).low > 0
    # Without pairs the same difference drowns.
    rolled = compare_pairs(first, np.roll(second, 1))
    assert rolled.sigma > 3 * compare_pairs(first, second).sigma


def test_order_changes_the_sign_and_nothing_else():
    first, second = injected(1, 20, 0.01, True)
    one, other = compare_pairs(first, second), compare_pairs(second, first)
    assert other.mean == pytest.approx(-one.mean)
    assert (-other.high, -other.low) == pytest.approx((one.low, one.high), abs=2e-4)
    assert other.equivalence == pytest.approx(one.equivalence, abs=2e-4)


def test_few_pairs_are_refused():
    with pytest.raises(ValueError, match="at least 6"):
        compare_pairs(np.zeros(5), np.zeros(5))


@pytest.mark.parametrize(
    ("found", "words"),
    [
        (
            PairedComparison(0.001, 0.002, -0.003, 0.005, 0.0044, 24),
            "equivalent within 0.44 % Strehl at 95",
        ),
        (
            PairedComparison(-0.04, 0.004, -0.048, -0.032, 0.047, 24),
            "B better than A by 4.00 ± 0.40 %",
        ),
        (PairedComparison(0.01, 0.02, -0.03, 0.05, 0.045, 24), "undecided"),
    ],
)
def test_the_words_follow_from_the_interval(found, words):
    assert words in describe_comparison("A", "B", found, 0.01)
