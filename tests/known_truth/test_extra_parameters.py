"""Extra parameters of SPRINT against injected values, zero and not zero."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from small_pyramid import configuration as small_pyramid
from small_system import GAUSSIAN
from small_system import configuration as small_lenslets

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.registration import Registration
from escape_hw.calibration.sprint.fit import sprint
from escape_hw.calibration.sprint.synthetic_matrix import (
    compute_fitted_matrix,
    compute_pseudo_synthetic_matrix,
)
from escape_hw.errors import ConfigError
from escape_hw.runtime.session.system import System
from escape_sim.mirror.influence_functions import actuator_positions, pitch_on_pupil
from escape_sim.mirror.rounded_exponential import draw_exponential
from escape_sim.models.factory import make_fast_model

SEEDS = range(6)
SHEAR = 1.5
SYSTEMS = {"lenslets": small_lenslets, "pyramid": small_pyramid}


@pytest.fixture(scope="module", params=SYSTEMS)
def model(request):
    return make_fast_model(SYSTEMS[request.param](), None)


def realisation(seed: int) -> Registration:
    rng = np.random.default_rng(seed)
    return Registration.from_array(rng.uniform(-1, 1, 5) * [20, 20, 0.5, 1.5, 1.5])


def noisy(zonal: np.ndarray, model, seed: int, noise: float = 0.02) -> InteractionMatrix:
    """A matrix of single actuators with so much noise, relative to its rms."""
    sigma = np.full(zonal.shape, noise * zonal.std(), np.float32)
    data = zonal + sigma * np.random.default_rng(100 + seed).standard_normal(zonal.shape)
    geometry = getattr(model, "_pupils", None) or model._grid
    return InteractionMatrix(
        data.astype(np.float32), sigma, np.eye(model.n_act), geometry.valid, "x", "docrime", True
    )


def errors(estimate, truth: Registration) -> np.ndarray:
    return estimate.registration.to_array() - truth.to_array()


@pytest.mark.parametrize("shear", [-4.0, 0.0, 0.7, 3.0])
def test_a_shear_and_its_axes_are_the_same_stretch(shear):
    given = Registration(3.0, -2.0, 1.1, 2.5, -1.2)
    leaning = given.with_shear(shear)
    np.testing.assert_allclose(
        leaning.scaling_matrix, given.scaling_matrix + np.array([[0, shear], [shear, 0]]) / 100
    )
    straight, back = leaning.axis_scalings_and_shear
    assert back == pytest.approx(shear, abs=1e-12)
    np.testing.assert_allclose(straight.to_array(), given.to_array(), atol=1e-12)
    assert not straight.anamorphosis_angle


@pytest.mark.slow
def test_a_shear_is_recovered_within_its_error(model):
    pulls, blind = [], []
    for seed in SEEDS:
        truth = realisation(seed)
        matrix = noisy(model.zonal_matrix(truth.with_shear(SHEAR)), model, seed)
        found = sprint(matrix, model, extra_parameters=("anamorphosis",))
        assert found.converged, found.warnings
        shear = found.extras["anamorphosis"]
        assert shear.sigma < 0.2 * SHEAR
        pulls.append([(shear.value - SHEAR) / shear.sigma, *(errors(found, truth) / found.sigma)])
        blind.append(found.chi2 < sprint(matrix, model).chi2)
    assert np.mean(np.square(pulls)) < 2.5
    assert np.abs(pulls).max() < 4.5
    # The matrix is not explained as well without it.
    assert all(blind)


@pytest.mark.slow
def test_where_there_is_no_shear_asking_for_one_does_no_harm(model):
    pulls, wider = [], []
    for seed in SEEDS:
        truth = realisation(seed)
        matrix = noisy(model.zonal_matrix(truth), model, seed)
        plain, found = sprint(matrix, model), sprint(matrix, model, extra_parameters=("anamorphosis",))
        shear = found.extras["anamorphosis"]
        pulls.append(shear.value / shear.sigma)
        assert (np.abs(errors(found, truth)) < 4.5 * found.sigma).all()
        wider.append(found.sigma / plain.sigma)
    assert np.mean(np.square(pulls)) < 3
    assert (np.median(wider, axis=0) < 1.3).all()


def test_a_shear_is_recovered_on_a_mirror_unlike_the_nominal_one():
    config = small_lenslets(*GAUSSIAN)
    model, pulls = make_fast_model(config, None), []
    for seed in (0, 1):
        mirror = draw_exponential(
            actuator_positions(config), pitch_on_pupil(config), np.random.default_rng(seed),
            gain_scatter=0.05, length_scatter=0.02,
        )  # fmt: skip
        truth, nodes = realisation(seed), model._slopes.nodes_m
        surfaces = mirror.surfaces(truth.with_shear(SHEAR), model.sub_aperture_m, nodes, nodes)
        zonal = model._slopes.slopes(np.moveaxis(surfaces, 0, 2).copy()) * model._opd_per_command_m
        found = sprint(noisy(zonal, model, seed), model, extra_parameters=("anamorphosis",))
        assert found.converged, found.warnings
        shear = found.extras["anamorphosis"]
        assert shear.sigma < 0.2 * SHEAR
        pulls.append([(shear.value - SHEAR) / shear.sigma, *(errors(found, truth) / found.sigma)])
    assert np.abs(pulls).max() < 4


def test_a_shear_is_in_the_pseudo_synthetic_matrix(model):
    truth = realisation(1)
    with_shear = model.zonal_matrix(truth.with_shear(SHEAR))
    matrix = noisy(with_shear, model, 1)

    def missed(estimate):
        made, _ = compute_pseudo_synthetic_matrix(model, estimate, np.eye(model.n_act))
        return np.square(made - with_shear).sum() / np.square(with_shear).sum()

    assert missed(sprint(matrix, model, extra_parameters=("anamorphosis",))) < 0.2 * missed(
        sprint(matrix, model)
    )


def test_a_shear_stays_with_a_mirror_that_moves_on(model):
    """As for a tracker, which follows the registration alone."""
    truth, basis = realisation(1), np.eye(model.n_act)
    found = sprint(
        noisy(model.zonal_matrix(truth.with_shear(SHEAR)), model, 1),
        model,
        extra_parameters=("anamorphosis",),
    )
    there = Registration.from_array(found.registration.to_array() + np.array([8.0, -5.0, 0.2, 0.0, 0.0]))
    with_shear = model.zonal_matrix(there.with_shear(found.extras["anamorphosis"].value), found.width.value)
    alike = replace(found, actuator_corrections=None)
    np.testing.assert_allclose(
        compute_fitted_matrix(model, there, alike, basis), with_shear, atol=1e-3 * np.abs(with_shear).max()
    )
    bare = compute_fitted_matrix(model, there, replace(alike, extras={}), basis)
    assert np.abs(bare - with_shear).max() > 1e-2 * np.abs(with_shear).max()


@pytest.mark.slow
def test_shifted_pupil_images_are_distinguished_from_a_shifted_mirror_by_their_rims():
    config = small_pyramid()
    model = make_fast_model(config, None)
    pulls = []
    for seed in SEEDS:
        truth, moved = realisation(seed), np.random.default_rng(seed).uniform(-15, 15, 2)
        matrix = noisy(model.with_pupil_shift(*moved).zonal_matrix(truth), model, seed)
        found = sprint(matrix, model, extra_parameters=("pupil_shift",))
        assert found.converged, found.warnings
        shift = [found.extras[name] for name in ("pupil_shift_x", "pupil_shift_y")]
        own = [(one.value - there) / one.sigma for one, there in zip(shift, moved, strict=True)]
        pulls.append([*own, *(errors(found, truth) / found.sigma)])
        assert max(one.sigma for one in shift) < 10
    # The change of the matrix is taken as linear in the shift.
    assert np.mean(np.square(pulls)) < 3.5
    assert np.abs(pulls).max() < 6


@pytest.mark.slow
def test_on_the_twin_an_injected_shear_is_recovered_and_reported():
    pulls = []
    for seed in (1, 2, 3):
        leaning = Registration(-16.0, -71.0, -0.77, 2.9, 0.0).with_shear(SHEAR)
        injected = [f"twin.registration.{name}={value!r}" for name, value in leaning.to_dict().items()]
        config = small_lenslets(*injected, 'calibration.extra_parameters=["anamorphosis"]', seed=seed)
        with System.from_config(config) as bench:
            found = bench.calibrate(frames=400).registration
        shear = found.extras["anamorphosis"]
        pulls.append((shear.value - SHEAR) / shear.sigma)
        assert shear.sigma < 0.5
    assert np.abs(pulls).max() < 4
    assert np.mean(np.square(pulls)) < 2.5


def test_what_a_model_or_solver_does_not_know_is_refused():
    model = make_fast_model(small_lenslets(), None)
    matrix = noisy(model.zonal_matrix(Registration()), model, 0)
    with pytest.raises(ConfigError, match="has no shift of the pupil"):
        sprint(matrix, model, extra_parameters=("pupil_shift",))
    with pytest.raises(ConfigError, match="needs solver = 'mixed-effects'"):
        sprint(matrix, model, extra_parameters=("anamorphosis",), solver="registration-only")
    assert not sprint(matrix, model).extras
