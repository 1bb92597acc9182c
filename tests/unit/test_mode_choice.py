"""Choosing modes by information, and reporting degenerate parameters."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from escape_hw.calibration.sprint.diagnostics import describe_degeneracies
from escape_hw.calibration.sprint.least_squares import MAX_STEP
from escape_hw.calibration.sprint.mode_choice import choose_by_fisher_information
from escape_hw.calibration.sprint.weighted_matrix import huber_weights

NAMES = ("gain", "shift_x", "shift_y", "rotation", "radial_scaling", "tangential_scaling")
UNIT = np.append(1.0, MAX_STEP)


@pytest.fixture(scope="module")
def by_mode() -> np.ndarray:
    rng = np.random.default_rng(2)
    jacobians = rng.standard_normal((9, 12, 6)) / UNIT * rng.uniform(0.1, 3, (9, 1, 1))
    return np.asarray(np.einsum("msp,msq->mpq", jacobians, jacobians))


def cost(by_mode: np.ndarray, chosen: tuple[int, ...], choice: str) -> float:
    information = by_mode[list(chosen)].sum(axis=0) * np.outer(UNIT, UNIT)
    covariance = np.linalg.inv(information)[1:, 1:]
    return float(np.linalg.slogdet(covariance)[1] if choice == "d-optimal" else np.trace(covariance))


@pytest.mark.parametrize("choice", ["d-optimal", "a-optimal"])
def test_the_greedy_choice_is_among_the_best(by_mode, choice):
    costs = {c: cost(by_mode, c, choice) for c in combinations(range(9), 4)}
    found = tuple(choose_by_fisher_information(by_mode, 4, choice).tolist())
    assert list(found) == sorted(found)
    better = sum(value < costs[found] - 1e-9 for value in costs.values())
    # The best of 126 sets, or nearly.
    assert better <= 6
    first, worst = costs[0, 1, 2, 3], max(costs.values())
    assert costs[found] < first < worst


def test_it_takes_all_there_are(by_mode):
    assert choose_by_fisher_information(by_mode, 20, "d-optimal").tolist() == list(range(9))


def test_a_degeneracy_is_named_with_its_reason():
    sigma = np.array([0.01, 0.1, 0.1, 0.01, 0.5, 0.5])
    correlation = np.eye(6)
    correlation[0, 4] = correlation[4, 0] = 0.999
    (note,) = describe_degeneracies(correlation * np.outer(sigma, sigma), NAMES)
    assert note.startswith("gain and radial scaling are hardly separable (a larger mirror")
    # 1 / sqrt(1 - 0.999^2) = 22.
    assert "22 times better" in note


def test_what_is_known_well_enough_is_not_mentioned():
    assert describe_degeneracies(np.eye(6), NAMES) == ()
    some = np.eye(6)
    some[1, 2] = some[2, 1] = 0.9
    assert describe_degeneracies(some, NAMES) == ()


def test_three_that_go_together_are_named_together():
    direction = np.array([0, 0, 0, 0, 1.0, -1.0]) + np.array([1.0, 0, 0, 0, 0, 0])
    direction /= np.linalg.norm(direction)
    covariance = np.eye(6) - (1 - 1e-4) * np.outer(direction, direction)
    (note,) = describe_degeneracies(covariance, NAMES)
    assert note.startswith("gain, radial scaling and tangential scaling are hardly separable")


def test_only_outlying_sub_apertures_have_less_weight():
    residual = np.random.default_rng(0).standard_normal((60, 40))
    assert huber_weights(residual).min() > 0.9
    residual[[3, 33]] *= 10
    shares = huber_weights(residual)
    np.testing.assert_allclose(shares[[3, 33]], 0.15, atol=0.03)
    assert np.delete(shares, [3, 33]).min() > 0.9
