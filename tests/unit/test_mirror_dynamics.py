"""The mirror follows its differential equation."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp

from escape_sim.mirror.dynamics import MirrorDynamics

SETTLING = 4e-4


def dynamics(n=1, creep=0.0, creep_time=30.0, settling=SETTLING):
    return MirrorDynamics(n, settling, creep, creep_time)


def rate():
    """Natural frequency of a critically damped system that is within 5 % after SETTLING."""
    # (1 + x) exp(-x) = 0.05
    x = 4.0
    for _ in range(60):
        x = np.log((1 + x) / 0.05)
    return x / SETTLING


def by_integration(commands, end):
    """Position as a function of time from the second-order equation, solved piece by piece."""
    w = rate()
    pieces, state, now, target = [], np.zeros(2), 0.0, 0.0
    for at, value in [*commands, (end, None)]:
        if at > now:
            solution = solve_ivp(
                lambda t, y, goal: [y[1], w * w * (goal - y[0]) - 2 * w * y[1]], (now, at), state,
                args=(target,), rtol=1e-10, atol=1e-12, dense_output=True, method="DOP853",
            )  # fmt: skip
            pieces.append((now, at, solution.sol))
            state, now = solution.y[:, -1], at
        target = value

    def position(t):
        for start, stop, sol in pieces:
            if start <= t <= stop:
                return float(sol(t)[0])
        raise ValueError(t)

    return position


COMMANDS = [(0.2e-3, 0.5), (0.35e-3, -0.3), (2.1e-3, 0.8), (2.15e-3, 0.1), (3.0e-3, -1.0)]


def test_exposures_see_the_mean_of_the_true_motion():
    position = by_integration(COMMANDS, 6e-3)
    mirror = dynamics()
    for at, value in COMMANDS:
        mirror.command(at, np.array([value]))
    edges = [0.0, 0.1e-3, 0.3e-3, 1.9e-3, 2.0e-3, 3.2e-3, 3.3e-3, 5.9e-3]
    breaks = [at for at, _ in COMMANDS]
    for start, end in pairwise(edges):
        inside = [b for b in breaks if start < b < end] or None
        want = quad(position, start, end, points=inside, limit=200)[0] / (end - start)
        assert mirror.mean(start, end)[0] == pytest.approx(want, abs=5e-5)


def test_gaps_between_exposures_do_not_matter():
    whole, parts = dynamics(), dynamics()
    for mirror in (whole, parts):
        for at, value in COMMANDS:
            mirror.command(at, np.array([value]))
    for start in (0.1e-3, 0.9e-3, 2.4e-3):
        parts.mean(start, start + 0.2e-3)
    assert parts.mean(4e-3, 5e-3) == pytest.approx(whole.mean(4e-3, 5e-3), abs=1e-12)


def test_a_step_settles_within_five_per_cent():
    mirror = dynamics()
    mirror.command(0.0, np.ones(1))
    assert mirror.mean(SETTLING, SETTLING)[0] == pytest.approx(0.95, abs=1e-3)
    assert mirror.mean(20 * SETTLING, 21 * SETTLING)[0] == pytest.approx(1.0, abs=1e-9)


def test_nothing_happens_before_a_command_arrives():
    mirror = dynamics()
    mirror.command(2e-3, np.ones(1))
    assert mirror.mean(0.0, 2e-3)[0] == 0
    assert 0 < mirror.mean(2e-3, 2.1e-3)[0] < 1


def test_a_critically_damped_mirror_does_not_overshoot():
    mirror = dynamics()
    mirror.command(0.0, np.ones(1))
    means = [mirror.mean(k * 2e-5, (k + 1) * 2e-5)[0] for k in range(200)]
    assert (np.diff(means) >= -1e-12).all()
    assert max(means) <= 1 + 1e-12


def test_commands_saturate_at_full_stroke():
    mirror = dynamics(4)
    mirror.command(0.0, np.array([3.0, -2.5, 0.5, -0.5]))
    assert mirror.mean(0.1, 0.2) == pytest.approx([1, -1, 0.5, -0.5])


def test_actuators_are_independent():
    together, alone = dynamics(3), dynamics()
    for at, value in COMMANDS:
        together.command(at, np.array([value, 0.0, -value]))
        alone.command(at, np.array([value]))
    a, b = together.mean(3e-3, 3.4e-3), alone.mean(3e-3, 3.4e-3)
    assert a == pytest.approx([b[0], 0.0, -b[0]], abs=1e-14)


@pytest.mark.parametrize("time", [1.0, 5.0, 20.0, 200.0])
def test_creep_approaches_its_share_exponentially(time):
    mirror = dynamics(creep=0.02, creep_time=10.0)
    mirror.command(0.0, np.full(1, 0.5))
    want = 0.5 * (1 + 0.02 * (1 - np.exp(-time / 10.0)))
    # The creep within the exposure itself is not resolved.
    assert mirror.mean(time, time + 2e-3)[0] == pytest.approx(want, abs=1e-5)


def test_creep_follows_the_mean_of_fast_pokes():
    mirror = dynamics(creep=0.05, creep_time=0.5)
    for k in range(2000):
        mirror.command(k * 2e-3, np.array([0.6 if k % 2 else 0.2]))
    mirror.command(4.0, np.zeros(1))
    # Long after the last poke settled, long before the creep is gone.
    assert mirror.mean(4.004, 4.005)[0] == pytest.approx(0.05 * 0.4 * np.exp(-0.0045 / 0.5), rel=0.02)


def test_time_that_has_passed_is_cut_off():
    mirror = dynamics()
    mirror.command(0.0, np.ones(1))
    mirror.mean(0.0, 1e-3)
    now = mirror.mean(0.2e-3, 0.9e-3)
    assert now == pytest.approx(mirror.mean(1e-3, 1e-3))
    assert now[0] > 0.99
