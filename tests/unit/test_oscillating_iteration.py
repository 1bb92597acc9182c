"""An iteration whose steps overshoot converges, and one that does not is reported."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from escape_hw.api.procedure import run
from escape_hw.api.registration import Registration
from escape_hw.calibration.sprint.normal_equations import Priors
from escape_hw.calibration.sprint.solvers import SolverContext, _fit_mixed_effects


@dataclass
class Place:
    alpha: np.ndarray
    gain: float = 1.0
    width: float = 0.0


@dataclass
class System:
    """Tells the way to zero, ``too_far`` times as long as it is."""

    alpha: np.ndarray
    too_far: float
    residual: np.ndarray

    def solve(self):
        return np.concatenate([[0.0], -self.too_far * self.alpha])

    def information(self):
        return np.eye(6) * 1e12


class Weighted:
    def noise_level(self, residual):
        return 1.0


class Overshooting:
    """What is left hardly depends on the registration, as where a model misses much more than noise."""

    weighted, precision = Weighted(), np.zeros(6)

    def __init__(self, too_far, at_least=0.0):
        self.too_far, self.at_least, self.steps = too_far, at_least, 0

    def linearise(self, state):
        self.steps += 1
        # Never nearer than so, in either direction.
        nearest = np.copysign(self.at_least, state.alpha)
        alpha = np.where(np.abs(state.alpha) < self.at_least, nearest, state.alpha)
        return System(alpha, self.too_far, np.full((4, 3), 100.0))

    def extrapolate_residual(self, state):
        return np.full((4, 3), 100.0)

    def move(self, state, step):
        return replace(state, alpha=state.alpha + step[1:6])

    def offset(self, state):
        return np.zeros(6)

    def extra_parameter_values(self, state):
        return ()

    def excess_scatters(self, state, system):
        return {}


def descend(problem, most=40, learning_rate=1.0):
    context = SolverContext(None, None, np.arange(3), "mixed-effects", learning_rate, most, Priors())
    start = Place(Registration(shift_x=1.0, shift_y=-0.5).to_array())
    return run(_fit_mixed_effects(problem, start, context))


@pytest.mark.parametrize("too_far", [1.0, 1.7, 2.4, 5.0])
def test_steps_that_overshoot_are_shortened_until_they_do_not(too_far):
    found = descend(Overshooting(too_far))
    assert found.steps_converged
    assert np.abs(found.alpha).max() < 0.01


def test_an_iteration_that_oscillates_is_ended_with_its_remaining_step():
    problem = Overshooting(30.0, at_least=0.05)
    found = descend(problem)
    assert not found.steps_converged
    assert problem.steps < 40
    assert found.remaining_step is not None
    assert np.abs(found.remaining_step[0]) == pytest.approx(30 * np.abs(found.alpha[0]).clip(0.05), rel=1e-6)


@pytest.mark.parametrize(("learning_rate", "most"), [(0.02, 3), (1.0, 0)])
def test_what_is_left_of_a_descent_that_was_cut_is_the_whole_step_not_the_share_that_was_taken(
    learning_rate, most
):
    found = descend(Overshooting(1.0), most, learning_rate)
    assert not found.steps_converged
    assert found.remaining_step == pytest.approx(-found.alpha)
    assert found.alpha[0] == pytest.approx((1 - learning_rate) ** most)
