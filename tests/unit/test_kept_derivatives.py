"""The mixed-effects fit keeps its derivatives while the fitted matrix hardly changes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from small_system import configuration

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.registration import Registration
from escape_hw.calibration.sprint.mixed_effects import (
    _KEEP_BELOW,
    _SAME_BELOW,
    MixedEffectsProblem,
    MixedEffectsState,
)
from escape_hw.calibration.sprint.normal_equations import Priors
from escape_hw.calibration.sprint.weighted_matrix import WeightedMatrix
from escape_sim.models.factory import make_fast_model
from escape_sim.models.shack_hartmann import nominal_grid

N_MODES = 3


@pytest.fixture(scope="module")
def problem() -> MixedEffectsProblem:
    config = configuration("sensor.n_sub=6")
    grid = nominal_grid(config)
    model = make_fast_model(config, grid)
    data = model.zonal_matrix(Registration(3.0, -2.0)).astype(np.float32)[:, :N_MODES]
    matrix = InteractionMatrix(
        data, np.ones_like(data), np.eye(model.n_act)[:, :N_MODES], grid.valid, "razor-shwfs", "docrime", True
    )
    return MixedEffectsProblem(WeightedMatrix.from_columns(matrix, np.arange(N_MODES)), model, Priors())


@pytest.fixture
def state(problem: MixedEffectsProblem) -> MixedEffectsState:
    problem.kept = None
    return problem.initial_state(Registration())


def scaled(state: MixedEffectsState, change: float) -> MixedEffectsState:
    """A state whose matrix is that of another one, multiplied by ``1 + change``."""
    return replace(state, gain=state.gain * (1 + change))


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(("share", "kept"), [(0.9, True), (1.1, False)])
def test_derivatives_are_kept_below_a_change_of_the_matrix(problem, state, sign, share, kept):
    first = problem.linearise(state)
    moved = scaled(state, sign * share * _KEEP_BELOW)
    second = problem.linearise(moved)
    assert (second.common is first.common) == kept
    # The residual is that of the new state in either case.
    fitted = problem.weighted.weigh(problem.matrix(moved, problem.modes))
    np.testing.assert_allclose(problem.weighted.data - second.residual, fitted, atol=1e-5)


def test_steps_add_up_until_the_derivatives_are_renewed(problem, state):
    first = problem.linearise(state)
    half_way = problem.linearise(scaled(state, 0.6 * _KEEP_BELOW))
    assert half_way.common is first.common
    assert problem.linearise(scaled(state, 1.2 * _KEEP_BELOW)).common is not first.common


@pytest.mark.parametrize(("share", "kept"), [(0.9, True), (1.1, False)])
def test_a_solution_keeps_derivatives_of_practically_the_same_matrix_only(problem, state, share, kept):
    first = problem.linearise(state)
    solution = scaled(state, share * _SAME_BELOW)
    system = problem.linearise(solution)
    assert system.common is first.common
    assert (problem.relinearise(solution, system).common is first.common) == kept
