"""A weak matrix is fitted with the mirror of an earlier calibration: what changed is the registration."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from small_matrices import MODEL, NOISE, TRUTH, measured, true_matrix

from escape_hw.api.registration import Registration
from escape_hw.api.results import RegistrationEstimate
from escape_hw.calibration.sprint.fit import sprint
from escape_hw.calibration.sprint.mixed_effects import MixedEffectsProblem
from escape_hw.calibration.sprint.normal_equations import Priors
from escape_hw.calibration.sprint.synthetic_matrix import compute_fitted_matrix
from escape_hw.calibration.sprint.weighted_matrix import WeightedMatrix

#: Noise of the later matrix, relative to the calibration's.
WEAKER = 15.0
LATER = Registration(TRUTH.shift_x + 4.0, TRUTH.shift_y - 3.0, TRUTH.rotation + 0.1, 1.1, -0.8)


@pytest.fixture(scope="module")
def calibration() -> RegistrationEstimate:
    return sprint(measured(0), MODEL)


def problem(data: NDArray[np.floating], noise: float, priors: Priors) -> MixedEffectsProblem:
    matrix = replace(
        measured(0), data=data.astype(np.float32), sigma=np.full(data.shape, noise, dtype=np.float32)
    )
    return MixedEffectsProblem(WeightedMatrix.from_columns(matrix, np.arange(37)), MODEL, priors)


def mirror(calibration: RegistrationEstimate) -> Priors:
    width = calibration.width
    return Priors(width=width.sigma, mean_width=width.value - 1, actuators=calibration.actuator_corrections)


def test_a_fit_begins_with_it(calibration: RegistrationEstimate) -> None:
    start = problem(measured(0).data, NOISE, mirror(calibration))
    state = start.initial_state(calibration.registration)
    assert not start.offset(state).any()
    fitted = compute_fitted_matrix(MODEL, calibration.registration, calibration, np.eye(37))
    np.testing.assert_allclose(
        start.matrix(state, np.eye(37)) / state.gain, fitted, atol=1e-3 * np.abs(fitted).max()
    )


@pytest.mark.slow
def test_the_change_of_the_registration_is_better_with_it(calibration: RegistrationEstimate) -> None:
    """Small pokes do not determine the mirror again."""
    true, change = true_matrix(LATER), LATER.to_array() - TRUTH.to_array()
    nominal = replace(mirror(calibration), actuators=None)
    errors: dict[bool, list[NDArray[np.float64]]] = {True: [], False: []}
    for seed in range(6):
        noise = WEAKER * NOISE
        data = true + noise * np.random.default_rng(seed).normal(size=true.shape)
        for known, priors in ((True, mirror(calibration)), (False, nominal)):
            for _ in range(2):
                later = problem(data, noise, priors)
                state = later.initial_state(calibration.registration)
                for _ in range(5):
                    system = later.linearise(state)
                    state = later.move(state, system.solve())
                priors = later.estimate_priors(state, system).priors
            errors[known].append(state.alpha - calibration.registration.to_array() - change)
    with_it, without = (np.sqrt(np.mean(np.square(errors[known]), axis=0)) for known in (True, False))
    # Geometric mean over the parameters.
    assert np.exp(np.mean(np.log(with_it / without))) < 0.8
