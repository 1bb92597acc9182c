"""The coarse search captures matrices of single actuators from several sub-apertures away."""

from __future__ import annotations

import numpy as np
import pytest
from small_system import configuration

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.registration import Registration
from escape_hw.calibration.sprint.coarse_search import search_registration, weigh_low_modes
from escape_sim.models.factory import make_fast_model
from escape_sim.models.shack_hartmann import nominal_grid

#: Relative to the largest element.
NOISE = 0.2


@pytest.fixture(scope="module")
def design():
    config = configuration()
    grid = nominal_grid(config)
    return make_fast_model(config, grid), grid


def zonal(design, registration, seed):
    model, grid = design
    clean = model.zonal_matrix(registration)
    sigma = NOISE * np.abs(clean).max()
    data = clean + sigma * np.random.default_rng(seed).normal(size=clean.shape)
    noise = np.full(clean.shape, sigma, np.float32)
    return InteractionMatrix(
        data.astype(np.float32), noise, np.eye(clean.shape[1]), grid.valid, "small", "push-pull", True
    )


@pytest.mark.parametrize("seed", range(6))
def test_low_modes_of_a_zonal_matrix_lead_to_its_registration(design, seed):
    rng = np.random.default_rng(seed)
    true = Registration(*rng.uniform(-400, 400, 2), rng.uniform(-9, 9), *rng.uniform(-2, 2, 2))
    matrix = zonal(design, true, seed)
    steps = list(search_registration(matrix, design[0], np.arange(37), np.zeros(5), 20))
    assert np.abs(steps[-1].alpha - true.to_array())[:2].max() < 15
    # A descent on rim actuators fails, and hundreds of starting points are tried.
    assert len(steps) < 30


def test_low_modes_are_the_first_columns_of_a_modal_matrix(design):
    model, grid = design
    m2c = np.linalg.qr(np.random.default_rng(1).normal(size=(37, 20)))[0]
    data = (model.zonal_matrix(Registration()) @ m2c).astype(np.float32)
    matrix = InteractionMatrix(data, np.ones_like(data), m2c, grid.valid, "small", "push-pull", True)
    weighted = weigh_low_modes(matrix, model, np.arange(20))
    assert np.array_equal(weighted.m2c, m2c[:, :5])
