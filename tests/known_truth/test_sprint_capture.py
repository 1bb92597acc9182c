"""From how far SPRINT finds home, and that it says so when it does not."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from escape_hw.api.matrix import InteractionMatrix
from escape_hw.api.registration import Registration
from escape_hw.calibration.modes import karhunen_loeve
from escape_hw.calibration.sprint import sprint
from escape_hw.config.load import load_system
from escape_sim.model import ShackHartmannModel, make_model, nominal_grid

#: Noise of the matrix elements, relative to their rms.
NOISE = 0.03


@pytest.fixture(scope="module")
def model() -> ShackHartmannModel:
    return make_model(load_system("razor-shwfs"), None)


@pytest.fixture(scope="module")
def matrix_at(model: ShackHartmannModel) -> Callable[[Registration], InteractionMatrix]:
    config = load_system("razor-shwfs")
    surfaces, pupil, pixel = model.influence_functions()
    m2c = karhunen_loeve(surfaces, pupil, pixel, 40, 4 * config.system.pupil_m)
    valid = nominal_grid(config).valid

    def make(registration: Registration) -> InteractionMatrix:
        exact = model.zonal_matrix(registration) @ m2c
        sigma = np.full(exact.shape, NOISE * exact.std())
        data = exact + sigma * np.random.default_rng(1).standard_normal(exact.shape)
        return InteractionMatrix(
            data.astype(np.float32), sigma.astype(np.float32), m2c, valid, "razor-shwfs", "docrime", True
        )

    return make


@pytest.mark.parametrize(
    "planted",
    [
        Registration(shift_x=-200.0, shift_y=150.0),
        Registration(rotation=10.0),
        Registration(0, 0, 0, 10, -10),
    ],
    ids=str,
)
def test_finds_home_from_afar(model, matrix_at, planted):
    estimate = sprint(matrix_at(planted), model)
    assert estimate.converged
    error = estimate.registration.to_array() - planted.to_array()
    assert (np.abs(error) < [0.5, 0.5, 0.02, 0.1, 0.1]).all()
    assert estimate.chi2 == pytest.approx(1.0, abs=0.1)


def test_a_shift_by_more_than_a_pitch_is_not_passed_off_as_found(model, matrix_at):
    planted = Registration(shift_x=400.0)
    estimate = sprint(matrix_at(planted), model, max_iterations=10)
    assert not estimate.converged
    assert any("explains" in warning for warning in estimate.warnings)
    assert sprint(matrix_at(planted), model, start=Registration(shift_x=300.0)).converged
