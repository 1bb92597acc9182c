"""The pseudo-synthetic matrix of a mirror with unequal actuators, against the mirror that was injected."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
import small_pyramid
import small_system

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.registration import Registration
from escape_hw.api.synthetic_model import SyntheticModel
from escape_hw.calibration.modes.bases import build_basis
from escape_hw.calibration.sprint.fit import sprint
from escape_hw.calibration.sprint.synthetic_matrix import (
    compute_fitted_matrix,
    compute_pseudo_synthetic_matrix,
)
from escape_hw.runtime.session.system import System
from escape_sim.models.factory import make_fast_model
from escape_sim.models.pyramid import PyramidModel, nominal_pupils
from escape_sim.models.shack_hartmann import nominal_grid

INJECTED = Registration(-16.0, 31.0, -0.77, 1.9, 0.5)
SEEDS = range(4)
#: Width of the broad part of the injected influence functions, relative to their own.
BROAD = 1.7


@dataclass(frozen=True)
class Design:
    """A sensor's model and the basis of its calibration."""

    model: SyntheticModel
    valid: np.ndarray
    m2c: np.ndarray


def lenslets() -> Design:
    config = small_system.configuration()
    model = make_fast_model(config, None)
    m2c = build_basis(config, *model.influence_functions(), ())
    return Design(model, nominal_grid(config).valid, m2c)


def pyramid() -> Design:
    config = small_pyramid.configuration()
    model = PyramidModel(config, nominal_pupils(config))
    return Design(model, nominal_pupils(config).valid, build_basis(config, *model.influence_functions(), ()))


@pytest.fixture(scope="module", params=[lenslets, pyramid])
def design(request: pytest.FixtureRequest) -> Design:
    made: Callable[[], Design] = request.param
    return made()


def injected(design: Design, seed: int, pedestal: float = 0.02) -> np.ndarray:
    """Slopes per command of a mirror whose actuators differ, and behind unequal slopes."""
    model, rng = design.model, np.random.default_rng(seed)
    gains, widths = rng.normal(1, 0.05, model.n_act), rng.normal(1.04, 0.03, model.n_act)
    zonal = np.stack([model.zonal_matrix(INJECTED, w)[:, a] for a, w in enumerate(widths)], axis=1)
    broad = np.stack([model.zonal_matrix(INJECTED, BROAD * w)[:, a] for a, w in enumerate(widths)], axis=1)
    return np.asarray(((1 - pedestal) * zonal + pedestal * broad) * gains)


def measured(design: Design, zonal: np.ndarray, noise: float, seed: int) -> InteractionMatrix:
    """Its matrix, with noise of a share of the elements' rms, behind slopes of unequal gains."""
    rng = np.random.default_rng(seed + 100)
    exact = (zonal * rng.normal(1, 0.03, (len(zonal), 1))) @ design.m2c
    sigma = np.full(exact.shape, noise * exact.std(), np.float32)
    data = (exact + sigma * rng.standard_normal(exact.shape)).astype(np.float32)
    return InteractionMatrix(data, sigma, design.m2c, design.valid, "small", "docrime", True)


def missed(made: np.ndarray, exact: np.ndarray) -> float:
    """What a matrix has of the wrong shape: columns have the right length, as optical gains see to."""
    made = made * ((made * exact).sum(axis=0) / np.square(made).sum(axis=0))
    return float(np.linalg.norm(made - exact) / np.linalg.norm(exact))


def compared(design: Design, noise: float, m2c: np.ndarray | None = None) -> np.ndarray:
    """Errors ``(n_seeds, 2)`` of the matrix of the fitted mirror, and of the nominal one."""
    errors, basis = [], design.m2c if m2c is None else m2c
    for seed in SEEDS:
        zonal = injected(design, seed)
        estimate = sprint(measured(design, zonal, noise, seed), design.model, update_priors=True)
        made = [
            compute_pseudo_synthetic_matrix(design.model, one, basis)[0]
            for one in (estimate, replace(estimate, actuator_corrections=None))
        ]
        errors.append([missed(one, zonal @ basis) for one in made])
    return np.array(errors)


# Each of these two with one sensor, together with both; the other halves are slow.
@pytest.mark.parametrize("design", [lenslets, pytest.param(pyramid, marks=pytest.mark.slow)], indirect=True)
def test_a_well_measured_mirror_is_recovered(design: Design) -> None:
    found, nominal = compared(design, 0.1).T
    assert (found < 0.25 * nominal).all()


@pytest.mark.slow
def test_a_mirror_with_a_large_pedestal_is_recovered(design: Design) -> None:
    errors = []
    for seed in SEEDS:
        zonal = injected(design, seed, 0.4)
        estimate = sprint(measured(design, zonal, 0.1, seed), design.model, update_priors=True)
        assert estimate.converged, estimate.warnings
        off = estimate.registration.to_array() - INJECTED.to_array()
        assert (np.abs(off) < 4 * np.sqrt(np.diag(estimate.covariance))).all()
        made = compute_pseudo_synthetic_matrix(design.model, estimate, design.m2c)[0]
        errors.append(missed(made, zonal @ design.m2c))
    assert np.mean(errors) < 0.014


@pytest.mark.slow
def test_a_poorly_measured_mirror_is_not_changed(design: Design) -> None:
    """Noise of three times the elements' rms: single actuators cannot be distinguished."""
    found, nominal = compared(design, 3.0).T
    assert found.mean() < 1.05 * nominal.mean()
    assert (found < 1.2 * nominal).all()


@pytest.mark.parametrize("design", [pytest.param(lenslets, marks=pytest.mark.slow), pyramid], indirect=True)
def test_the_matrix_holds_for_modes_that_were_never_poked(design: Design) -> None:
    other = np.random.default_rng(1).standard_normal((design.model.n_act, 12))
    # Single actuators are poked alone by no mode of the calibration.
    found, nominal = compared(design, 0.1, other).T
    assert (found < 0.6 * nominal).all()


def test_corrections_belong_to_actuators_and_not_to_modes(design: Design) -> None:
    zonal = injected(design, 0)
    estimate = sprint(measured(design, zonal, 0.1, 0), design.model)
    turn = np.random.default_rng(2).standard_normal((design.m2c.shape[1], 5))
    made, turned = (
        compute_fitted_matrix(design.model, estimate.registration, estimate, m2c)
        for m2c in (design.m2c, design.m2c @ turn)
    )
    np.testing.assert_allclose(turned, made @ turn, atol=1e-4 * np.abs(turned).max())


def test_its_errors_include_single_actuators(design: Design) -> None:
    zonal = injected(design, 0)
    estimate = sprint(measured(design, zonal, 1.0, 0), design.model, update_priors=True)
    made, sigma = compute_pseudo_synthetic_matrix(design.model, estimate, design.m2c)
    scale = float(np.vdot(made, zonal @ design.m2c) / np.vdot(made, made))
    pulls = (scale * made - zonal @ design.m2c) / sigma
    assert 0.2 < np.mean(np.square(pulls)) < 5
    apart = estimate.actuator_corrections
    assert apart is not None
    sure = replace(estimate, actuator_corrections=replace(apart, gain_sigma=0 * apart.gain_sigma))
    assert compute_pseudo_synthetic_matrix(design.model, sure, design.m2c)[1].mean() < sigma.mean()


def test_nominal_is_the_matrix_of_the_nominal_mirror(design: Design) -> None:
    matrix = measured(design, injected(design, 0), 0.1, 0)
    found = sprint(matrix, design.model)
    nominal = sprint(matrix, design.model, actuator_model="nominal")
    assert found.actuator_corrections is not None
    assert nominal.actuator_corrections is None
    np.testing.assert_array_equal(nominal.registration.to_array(), found.registration.to_array())
    made = compute_pseudo_synthetic_matrix(design.model, nominal, design.m2c)[0]
    drawn = design.model.zonal_matrix(nominal.registration, nominal.width.value) @ design.m2c
    np.testing.assert_allclose(made, nominal.gain.value * drawn, atol=1e-4 * np.abs(made).max())


@pytest.mark.parametrize("frames", [50, 400])
@pytest.mark.slow
def test_a_tenth_of_a_second_determines_unequal_actuators(frames: int) -> None:
    """The whole bench, compared with push-pull without turbulence."""
    errors = []
    for seed in (1, 2):
        with System.from_config(small_system.configuration(seed=seed)) as bench:
            result = bench.calibrate("escape", frames=frames)
            exact = bench.calibrate("push-pull", grid=result.grid).matrix.data.astype(float)
            estimate = result.registration
            assert estimate is not None
            drawn = replace(estimate, actuator_corrections=None)
            nominal = compute_pseudo_synthetic_matrix(bench.model(result.grid), drawn, result.matrix.m2c)[0]
            errors.append([missed(result.matrix.data.astype(float), exact), missed(nominal, exact)])
    found, nominal_error = np.array(errors).T
    assert (found < 0.85 * nominal_error).all()
