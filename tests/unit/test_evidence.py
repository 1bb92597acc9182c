"""Scatter of random effects that maximises the evidence."""

from __future__ import annotations

import numpy as np
import pytest

from escape_hw.calibration.sprint.mixed_effects import estimate_scatters

N = 400
GROUPS, BOUNDS = (np.arange(1, N + 1),), ((1e-3, 100.0),)


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
def test_the_assumed_scatter_does_not_matter(assumed: float) -> None:
    normal, value, precision, truth = solution(0.5, 0.5, assumed, 0)
    (ratio,) = estimate_scatters(normal, value, precision, GROUPS, BOUNDS)
    assert assumed * ratio == pytest.approx(truth[1:].std(), rel=0.15)


def test_absent_effects_have_no_scatter() -> None:
    scatters = []
    for seed in range(5):
        normal, value, precision, _ = solution(0.0, 0.5, 0.5, seed)
        assert value[1:].std() > 0.2
        scatters.append(0.5 * estimate_scatters(normal, value, precision, GROUPS, BOUNDS)[0])
    assert np.mean(scatters) < 0.15


def test_noise_in_other_units_gives_the_same() -> None:
    normal, value, precision, _ = solution(0.5, 0.5, 1.0, 1)
    want = estimate_scatters(normal, value, precision, GROUPS, BOUNDS)
    # The same data taken for three times as precise, with the solution that follows.
    sharper = 9 * (normal - np.diag(precision)) + np.diag(precision)
    pull = 9 * normal @ value
    got = estimate_scatters(sharper, np.linalg.solve(sharper, pull), precision, GROUPS, BOUNDS, noise=3.0)
    np.testing.assert_allclose(got, want, rtol=1e-6)
