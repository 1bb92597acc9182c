"""Derivatives of a mirror whose influence functions have a large pedestal, against differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import small_system

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.registration import PARAMETERS, Registration
from escape_hw.api.results import PEDESTAL, ActuatorCorrections, Estimate, RegistrationEstimate
from escape_hw.calibration.sprint.mixed_effects import SHAPE, WIDTH, MixedEffectsProblem, MixedEffectsState
from escape_hw.calibration.sprint.normal_equations import Priors
from escape_hw.calibration.sprint.synthetic_matrix import compute_fitted_jacobian, compute_fitted_matrix
from escape_hw.calibration.sprint.weighted_matrix import WeightedMatrix
from escape_sim.models.factory import make_fast_model
from escape_sim.models.shack_hartmann import ShackHartmannModel, nominal_grid

PLACE = Registration(-16.0, 31.0, -0.77, 1.9, 0.5)
#: Half steps of the differences by the registration, and by width and pedestal.
STEPS, SMALL_STEP = (1.0, 1.0, 0.03, 0.1, 0.1), 3e-3


@pytest.fixture(scope="module")
def model() -> ShackHartmannModel:
    return make_fast_model(small_system.configuration(), None)


@pytest.fixture(scope="module")
def problem(model: ShackHartmannModel) -> MixedEffectsProblem:
    """A mirror without pedestal, seen by a fit that starts elsewhere."""
    data = model.zonal_matrix(Registration(3.0, -5.0, 0.4, 0.2, 0.1)).astype(np.float32)
    valid = nominal_grid(small_system.configuration()).valid
    sigma, single = np.full(data.shape, 0.1, np.float32), np.eye(model.n_act)
    matrix = InteractionMatrix(data, sigma, single, valid, "small", "push-pull", True)
    return MixedEffectsProblem(WeightedMatrix.from_columns(matrix, np.arange(model.n_act)), model, Priors())


def beside(state: MixedEffectsState, name: str, sign: int) -> tuple[MixedEffectsState, float]:
    """A state half a step away, and how far that is."""
    if name in PARAMETERS:
        step = sign * STEPS[PARAMETERS.index(name)] * (np.array(PARAMETERS) == name)
        return replace(state, alpha=state.alpha + step), float(step.sum())
    return replace(state, **{name: getattr(state, name) + sign * SMALL_STEP}), sign * SMALL_STEP


@pytest.mark.parametrize("pedestal", [0.5, 0.2, -0.4, 0.0])
def test_a_fit_is_linearised_with_its_pedestal(problem: MixedEffectsProblem, pedestal: float) -> None:
    state = replace(problem.initial_state(PLACE), width=0.12, shape=pedestal)
    system = problem.linearise(state)
    for place, name in zip((*range(1, 6), WIDTH, SHAPE), (*PARAMETERS, "width", "shape"), strict=True):
        (more, up), (less, down) = (beside(state, name, sign) for sign in (1, -1))
        want = (problem.linearise(more).model - problem.linearise(less).model) / (up - down)
        assert np.linalg.norm(system.common[place] - want) < 1e-3 * np.linalg.norm(want), name


@pytest.mark.parametrize("pedestal", [0.5, -0.4])
def test_unequal_widths_spread_the_pedestal_too(
    problem: MixedEffectsProblem, model: ShackHartmannModel, pedestal: float
) -> None:
    """A thousandth of width, so that second orders do not matter."""
    state = replace(problem.initial_state(PLACE), gain=1.0, width=0.12, shape=pedestal)
    unequal = 1e-3 * np.random.default_rng(0).standard_normal(model.n_act)

    def whole(width: float) -> np.ndarray:
        own, broad = (model.zonal_matrix(PLACE, scale * width) for scale in (1.0, PEDESTAL))
        return np.asarray((1 - pedestal) * own + pedestal * broad)

    even = whole(1.12)
    want = np.stack([whole(1.12 * (1 + w))[:, a] for a, w in enumerate(unequal)], axis=1) - even
    fitted = problem.zonal_matrix(replace(state, actuator_width=unequal)) - problem.zonal_matrix(state)
    assert np.linalg.norm(fitted - want) < 0.01 * np.linalg.norm(want)
    nothing = np.zeros(model.n_act)
    single, estimate = np.eye(model.n_act), told(ActuatorCorrections(nothing, nothing, unequal, pedestal))
    alike = told(ActuatorCorrections(nothing, nothing, nothing, pedestal))
    made = compute_fitted_matrix(model, PLACE, estimate, single) - compute_fitted_matrix(
        model, PLACE, alike, single
    )
    assert np.linalg.norm(made - want) < 0.01 * np.linalg.norm(want)


def test_a_fitted_mirror_moves_with_its_pedestal(model: ShackHartmannModel) -> None:
    nothing, single = np.zeros(model.n_act), np.eye(model.n_act)
    open_gains = ActuatorCorrections(nothing, nothing + 0.01, nothing, 0.5)
    estimate = told(open_gains)
    matrix, derivatives, variance = compute_fitted_jacobian(model, estimate, single)
    np.testing.assert_allclose(variance, np.square(0.01 * matrix), atol=1e-4 * variance.max())
    for k, step in enumerate(np.diag(STEPS)):
        more, less = (Registration.from_array(PLACE.to_array() + sign * step) for sign in (1, -1))
        want = (
            compute_fitted_matrix(model, more, estimate, single)
            - compute_fitted_matrix(model, less, estimate, single)
        ) / (2 * step.sum())
        assert np.linalg.norm(derivatives[k] - want) < 1e-3 * np.linalg.norm(want), PARAMETERS[k]


def told(actuator_corrections: ActuatorCorrections) -> RegistrationEstimate:
    """An estimate with these departures."""
    return RegistrationEstimate(
        PLACE,
        np.eye(5),
        Estimate(1.0, 0.0),
        Estimate(1.12, 0.0),
        True,
        (),
        1.0,
        actuator_corrections=actuator_corrections,
    )
