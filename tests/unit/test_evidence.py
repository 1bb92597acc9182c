"""Random effects with the maximum-likelihood variance."""

from __future__ import annotations

import numpy as np
import pytest

from escape_hw.calibration.sprint.mixed_effects import empirical_bayes

N = 400
KINDS, BOUNDS = (slice(1, N + 1),), ((1e-3, 10.0),)


def solution(scatter: float, noise: float, assumed: float, seed: int) -> tuple[np.ndarray, ...]:
    """Effects measured once each behind a common level, solved with an assumed scatter of theirs."""
    rng = np.random.default_rng(seed)
    truth = np.concatenate([[2.0], scatter * rng.standard_normal(N)])
    design = np.concatenate([np.ones((N, 1)), np.eye(N)], axis=1)
    data = design @ truth + noise * rng.standard_normal(N)
    precision = np.concatenate([[0.0], np.full(N, assumed**-2)])
    normal = design.T @ design / noise**2 + np.diag(precision)
    return normal, np.linalg.solve(normal, design.T @ data / noise**2), precision, truth


@pytest.mark.parametrize("assumed", [0.05, 3.0])
def test_the_scatter_that_was_assumed_does_not_matter(assumed: float) -> None:
    normal, value, precision, truth = solution(0.5, 0.5, assumed, 0)
    found, sigma = empirical_bayes(normal, value, precision, KINDS, BOUNDS)
    error = (found - truth)[1:]
    # Signal and noise alike: half of the square is left.
    assert np.mean(np.square(error)) == pytest.approx(0.5 * 0.5**2, rel=0.2)
    assert np.mean(np.square(error / sigma[1:])) == pytest.approx(1.0, abs=0.25)


def test_effects_that_are_not_there_vanish() -> None:
    rest = []
    for seed in range(5):
        normal, value, precision, _ = solution(0.0, 0.5, 0.5, seed)
        assert value[1:].std() > 0.2
        rest.append(empirical_bayes(normal, value, precision, KINDS, BOUNDS)[0][1:].std())
    assert np.mean(rest) < 0.03


def test_noise_in_other_units_is_the_same() -> None:
    normal, value, precision, _ = solution(0.5, 0.5, 1.0, 1)
    want = empirical_bayes(normal, value, precision, KINDS, BOUNDS)
    # The same data taken for three times as precise, with the solution that follows.
    sharper = 9 * (normal - np.diag(precision)) + np.diag(precision)
    pull = 9 * normal @ value
    got = empirical_bayes(sharper, np.linalg.solve(sharper, pull), precision, KINDS, BOUNDS, noise=3.0)
    np.testing.assert_allclose(got[0], want[0], rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(got[1], want[1], rtol=1e-6)
