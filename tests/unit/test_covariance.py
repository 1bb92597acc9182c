"""Weights by distance: summed along rows and columns, or pair by pair."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from escape_hw.calibration.sprint.covariance import (
    _proximity,
    _sum_by_proximity,
    sandwich_covariance,
)
from escape_hw.calibration.sprint.weighted_matrix import WeightedMatrix


def test_sums_by_nearness_two_ways():
    rng = np.random.default_rng(2)
    valid = rng.random((7, 9)) > 0.3
    scores = rng.standard_normal((3, int(valid.sum())))
    np.testing.assert_allclose(_sum_by_proximity(valid, scores), scores @ _proximity(valid), atol=1e-12)


def test_nearness_falls_to_nothing_at_half_the_pupil():
    near = _proximity(np.ones((1, 11), bool))
    np.testing.assert_allclose(near[0], np.maximum(1 - np.arange(11) / 5.5, 0))
    assert np.linalg.eigvalsh(_proximity(np.ones((6, 8), bool))).min() > -1e-12


@dataclass
class Linear:
    """A linear model of six parameters, fitted."""

    derivatives: np.ndarray
    residual: np.ndarray

    def information(self):
        flat = self.derivatives.reshape(6, -1)
        return flat @ flat.T

    def projected_jacobian(self):
        return self.derivatives


@pytest.mark.parametrize("missed", [0.0, 0.5])
def test_stated_errors_are_those_of_fits_to_noise_that_neighbours_share(missed):
    # Truth is zero; the estimator sees noise, and half the time a pattern that its model misses.
    rng = np.random.default_rng(4)
    valid, n_modes = np.ones((10, 10), bool), 12
    places = np.argwhere(valid)
    distance = np.linalg.norm(places[:, None] - places, axis=2)
    noise = np.kron(np.eye(2), np.exp(-distance / 3.0))
    root = np.linalg.cholesky(noise)
    angle = places @ rng.normal(0, 0.6, (2, 12 * n_modes)) + rng.uniform(0, 6.3, 12 * n_modes)
    derivatives = np.sin(angle).T.reshape(6, n_modes, 200).swapaxes(1, 2) * 3.0
    flat = derivatives.reshape(6, -1)
    weighted = WeightedMatrix(
        np.zeros((200, n_modes)), np.ones(200), np.ones(n_modes), np.eye(n_modes), True, valid
    )
    errors, stated = [], []
    for _ in range(300):
        pattern = np.sin(np.tile(places, (2, 1)) @ rng.normal(0, 0.6, 2) + rng.uniform(0, 6.3))
        data = root @ rng.standard_normal((200, n_modes))
        data += missed * pattern[:, None] * rng.standard_normal(n_modes)
        found = np.linalg.solve(flat @ flat.T, flat @ data.ravel())
        left = data - np.tensordot(found, derivatives, 1)
        errors.append(found)
        stated.append(np.diag(sandwich_covariance(weighted, Linear(derivatives, left), noise)))
    ratio = np.mean(stated, axis=0) / np.mean(np.square(errors), axis=0)
    assert (ratio > 0.8).all(), ratio
    # What leaving out actuators, and a chi-squared above one by chance, add is never negative.
    assert (ratio < 2.0).all(), ratio


def fitted(seed):
    """A fit of six parameters to noise with a pattern that the model misses; the noise's covariance."""
    rng = np.random.default_rng(seed)
    valid = np.ones((8, 8), bool)
    places = np.tile(np.argwhere(valid), (2, 1))
    noise = np.exp(-np.linalg.norm(places[:, None] - places, axis=2) / 3.0) + 0.1 * np.eye(128)
    derivatives = rng.standard_normal((6, 128, 9))
    data = rng.standard_normal((128, 9)) + np.sin(places @ [0.5, 0.3])[:, None] * rng.standard_normal(9)
    flat = derivatives.reshape(6, -1)
    left = data - np.tensordot(np.linalg.solve(flat @ flat.T, flat @ data.ravel()), derivatives, 1)
    return valid, Linear(derivatives, left / np.sqrt(np.mean(np.square(left)))), noise


def weights(valid, measured):
    n_slopes = 2 * int(valid.sum())
    return WeightedMatrix(np.zeros((n_slopes, 9)), np.ones(n_slopes), np.ones(9), np.eye(9), measured, valid)


@pytest.mark.parametrize("correlated", [False, True])
def test_a_matrix_without_standard_errors_has_those_of_its_residual(correlated):
    valid, system, covariance = fitted(5)
    noise = covariance if correlated else None
    # In units of the matrix instead of its noise.
    coarse = Linear(system.derivatives / 20, system.residual / 20)
    np.testing.assert_allclose(
        sandwich_covariance(weights(valid, False), coarse, noise),
        sandwich_covariance(weights(valid, True), system, noise),
    )


def test_a_constant_slope_does_not_change_the_stated_errors():
    valid, system, noise = fitted(6)
    dead = noise.copy()
    dead[3], dead[:, 3] = 0.0, 0.0
    system.derivatives[:, 3], system.residual[3] = 0.0, 0.0
    with_dead, with_live = (sandwich_covariance(weights(valid, True), system, one) for one in (dead, noise))
    np.testing.assert_allclose(with_dead, with_live)
