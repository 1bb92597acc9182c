"""The SPRINT benchmark: the compared quantities, and rows for missing peers."""

from __future__ import annotations

import math

import numpy as np
import pytest

from escape_benchmarks.calibration import sprint
from escape_benchmarks.peers import specula as specula_sprint
from escape_benchmarks.peers.oopao import OopaoPeer, SolverResult
from escape_hw.api.registration import Registration
from escape_hw.calibration.modes.bases import karhunen_loeve
from escape_hw.config.loader import load_system
from escape_sim.models.factory import make_fast_model


@pytest.fixture(scope="module")
def alike():
    return load_system("razor-shwfs", overrides=sprint._OOPAO_SENSOR)


@pytest.fixture(scope="module")
def modes(alike):
    surfaces = make_fast_model(alike, None).influence_functions()
    return karhunen_loeve(*surfaces, 5, 4 * alike.system.pupil_m)


def test_ours_and_oopaos_sensor_give_the_same_matrix_and_ours_solves_it(alike, modes):
    peer = OopaoPeer(alike, modes)
    theirs = peer.matrix(sprint.INJECTED, sprint.mirror(False))
    ours = make_fast_model(alike, None).modal_matrix(sprint.INJECTED, modes)
    scale = np.vdot(ours, theirs) / np.vdot(ours, ours)
    assert np.linalg.norm(scale * ours - theirs) < 5e-6 * np.linalg.norm(theirs)
    answer = sprint.EscapeSolver(alike, modes).solver("registration-only", noise=False)(theirs)
    assert answer.valid
    error = np.abs(answer.registration.to_array() - sprint.INJECTED.to_array())
    assert (error < [0.01, 0.01, 1e-4, 3e-3, 3e-3]).all()


@pytest.mark.slow
def test_on_the_pyramid_both_solve_oopaos_matrix_and_ours_is_nearer():
    config = load_system("razor-pywfs", overrides=sprint._OOPAO_PYRAMID)
    model = make_fast_model(config, None)
    low = karhunen_loeve(*model.influence_functions(), 5, 4 * config.system.pupil_m)
    peer, at = OopaoPeer(config, low), sprint.injected(config)
    theirs = peer.matrix(at, sprint.mirror(False))
    ours = model.modal_matrix(at, low)
    scale = np.vdot(ours, theirs) / np.vdot(ours, ours)
    assert scale > 0
    assert np.linalg.norm(scale * ours - theirs) < 1e-4 * np.linalg.norm(theirs)
    peer.set_up()
    mine, other = (
        np.abs(solve(theirs).registration.to_array() - at.to_array())
        for solve in (sprint.EscapeSolver(config, low).solver("registration-only", noise=False), peer.solve)
    )
    assert (mine < [0.02, 0.02, 1e-4, 1e-3, 1e-3]).all()
    assert (other < [0.2, 0.2, 1e-3, 0.05, 0.05]).all()
    # What is injected is the same share of the pupil on both sensors.
    assert at.shift_x / config.sensor.n_sub == pytest.approx(sprint.INJECTED.shift_x / sprint.INJECTED_N_SUB)


def test_products_of_a_pyramid_matrix_are_counted_on_its_nodes():
    config = load_system("razor-pywfs", overrides=sprint._OOPAO_PYRAMID)
    one, whole = sprint._operations(config, 97, 5)
    twice, _ = sprint._operations(config, 97, 10)
    assert twice == 2 * one
    assert whole > 5 * one


def test_a_real_mirror_differs_from_the_ideal_one():
    ideal, real = sprint.mirror(False), sprint.mirror(True)
    assert (ideal.gains == 1).all()
    assert real.gains.std() == pytest.approx(sprint.GAIN_SCATTER, rel=0.3)
    assert real.coupling != ideal.coupling


def test_without_specula_there_is_a_row_that_states_it(monkeypatch, alike, modes):
    monkeypatch.setattr(sprint, "specula_peer", lambda *given: None)
    monkeypatch.setattr(sprint, "time_alternately", lambda ours, peer, **given: (ours() and 1.0, None))
    (row,) = sprint._specula_rows(alike, modes)
    assert row.peer is None
    assert row.ratio is None
    assert row.note == specula_sprint.MISSING
    assert math.isfinite(row.ours)


def test_results_far_away_count_only_when_correct_and_valid(monkeypatch, alike, modes):
    class Lost:
        """Always says zero; vouches for it every other time."""

        name, m2c, calls = "lost", modes, 0

        def matrix(self, registration, real):
            self.injected = registration
            return registration.to_array()

        def solve(self, data, iterations):
            self.calls += 1
            return SolverResult(Registration(), self.calls % 2 == 0)

    monkeypatch.setattr(
        sprint.EscapeSolver,
        "solver",
        lambda self, how, **given: lambda data: SolverResult(Registration.from_array(data), True),
    )
    found, wrong = sprint._capture_rows(alike, Lost(), "sprint")
    n = len(sprint.PITCHES) * len(sprint.DIRECTIONS)
    assert (found.ours, found.peer) == (n, 0)
    assert (wrong.ours, wrong.peer) == (0, n // 2)
