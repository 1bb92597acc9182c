"""Capture range of SPRINT, and its report when it does not converge."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.registration import Registration
from escape_hw.calibration.modes.bases import karhunen_loeve
from escape_hw.calibration.sprint.fit import sprint
from escape_hw.config.loader import load_system
from escape_sim.models.factory import make_fast_model
from escape_sim.models.shack_hartmann import ShackHartmannModel, nominal_grid

#: Noise of the matrix elements, relative to their rms.
NOISE = 0.03
#: Actuator pitch in % of a sub-aperture.
PITCH = 100 * 24 / 9
#: The paper's laboratory case.
PAPER = Registration(-16.0, -71.0, -0.77, 2.9, 0.0)


@pytest.fixture(scope="module")
def model() -> ShackHartmannModel:
    return make_fast_model(load_system("razor-shwfs"), None)


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
    "injected",
    [
        Registration(shift_x=-200.0, shift_y=150.0),
        pytest.param(Registration(rotation=10.0), marks=pytest.mark.slow),
        pytest.param(Registration(0, 0, 0, 10, -10), marks=pytest.mark.slow),
    ],
    ids=str,
)
def test_converges_from_large_misregistrations(model, matrix_at, injected):
    estimate = sprint(matrix_at(injected), model)
    assert estimate.converged
    error = estimate.registration.to_array() - injected.to_array()
    assert (np.abs(error) < [0.5, 0.5, 0.02, 0.1, 0.1]).all()
    assert estimate.chi2 == pytest.approx(1.0, abs=0.1)


@pytest.mark.slow
def test_a_shift_by_more_than_a_pitch_is_not_reported_as_converged(model, matrix_at):
    injected = Registration(shift_x=400.0)
    few = {"modes": 20, "coarse_search": False}
    estimate = sprint(matrix_at(injected), model, max_iterations=10, **few)
    assert not estimate.converged
    assert any("explains" in warning for warning in estimate.warnings)
    assert sprint(matrix_at(injected), model, start=Registration(shift_x=300.0), **few).converged


def random_far(number):
    """A shift by two actuator pitches in some direction, turned and scaled as far as one would."""
    rng = np.random.default_rng(100 + number)
    way = rng.uniform(0, 2 * np.pi)
    return Registration.from_array(
        [*(2 * PITCH * np.array([np.cos(way), np.sin(way)])), *(rng.uniform(-1, 1, 3) * [10, 8, 8])]
    )


@pytest.mark.parametrize(
    "solver", ["registration-only", pytest.param("mixed-effects", marks=pytest.mark.slow)]
)
def test_two_pitches_away_turned_and_scaled(model, matrix_at, solver):
    for number in range(4):
        injected = random_far(number)
        estimate = sprint(matrix_at(injected), model, solver=solver)
        assert estimate.converged, injected
        error = estimate.registration.to_array() - injected.to_array()
        assert (np.abs(error) < 5 * estimate.sigma).all(), injected


@pytest.mark.slow
@pytest.mark.parametrize("n_modes", [5, 40])
def test_random_registrations_are_recovered_or_refused(model, matrix_at, n_modes):
    """Anywhere within three pitches and far beyond: what is called converged is right."""
    found = 0
    for number in range(6):
        rng = np.random.default_rng(number)
        coarse_search = PITCH * rng.choice([0.3, 1.0, 3.0, 6.0])
        injected = Registration.from_array(
            [*rng.uniform(-coarse_search, coarse_search, 2), *(rng.uniform(-1, 1, 3) * [12, 8, 8])]
        )
        estimate = sprint(matrix_at(injected), model, modes=np.arange(n_modes), solver="registration-only")
        error = np.abs(estimate.registration.to_array() - injected.to_array())
        assert not estimate.converged or (error < 5 * estimate.sigma).all(), injected
        found += estimate.converged
    assert found >= 4


@pytest.mark.slow
def test_high_modes_alone_are_found_by_many_starts(model, matrix_at):
    injected = Registration(shift_x=400.0, shift_y=-250.0, rotation=4.0)
    columns = np.arange(20, 25)
    estimate = sprint(matrix_at(injected), model, modes=columns, solver="registration-only")
    assert estimate.converged
    assert (np.abs(estimate.registration.to_array() - injected.to_array()) < 5 * estimate.sigma).all()
    assert not sprint(
        matrix_at(injected), model, modes=columns, solver="registration-only", coarse_search=False
    ).converged


def test_both_solvers_agree_on_a_mirror_like_the_model(model, matrix_at):
    matrix = matrix_at(PAPER)
    light, full = (sprint(matrix, model, solver=s) for s in ("registration-only", "mixed-effects"))
    assert light.converged
    assert full.converged
    assert light.width.value == 1.0
    assert (np.abs(light.registration.to_array() - full.registration.to_array()) < 3 * full.sigma).all()
    assert (np.abs(light.registration.to_array() - PAPER.to_array()) < 4 * light.sigma).all()
    assert abs(light.gain.value - 1) < 4 * light.gain.sigma


def test_a_small_learning_rate_converges(model, matrix_at):
    estimate = sprint(matrix_at(PAPER), model, solver="registration-only", learning_rate=0.5)
    assert estimate.converged
    assert (np.abs(estimate.registration.to_array() - PAPER.to_array()) < 4 * estimate.sigma).all()


@pytest.mark.slow
def test_a_mirror_of_the_other_polarity_is_pointed_out(model, matrix_at):
    matrix = matrix_at(PAPER)
    for solver in ("registration-only", "mixed-effects"):
        estimate = sprint(replace(matrix, data=-matrix.data), model, modes=10, solver=solver)
        assert not estimate.converged
        assert any("polarity" in warning for warning in estimate.warnings)


@pytest.mark.slow
def test_a_flip_is_named(model, matrix_at):
    matrix = matrix_at(PAPER)
    n = matrix.n_slopes // 2
    flipped = np.zeros_like(matrix.data)
    for k in range(matrix.n_modes):
        x, y = matrix.maps(k)
        flipped[:n, k], flipped[n:, k] = -np.fliplr(x)[matrix.valid], np.fliplr(y)[matrix.valid]
    estimate = sprint(replace(matrix, data=flipped), model, modes=10, solver="registration-only")
    assert not estimate.converged
    assert any("mirrored left to right" in warning for warning in estimate.warnings), estimate.warnings
    turned = np.zeros_like(matrix.data)
    for k in range(matrix.n_modes):
        x, y = matrix.maps(k)
        turned[:n, k], turned[n:, k] = y.T[matrix.valid], x.T[matrix.valid]
    estimate = sprint(replace(matrix, data=turned), model, modes=10, solver="registration-only")
    assert not estimate.converged
    assert any("pupil transposed:" in warning for warning in estimate.warnings), estimate.warnings
