"""Prior variances estimated by SPRINT, outlying sub-apertures, and refused options."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.registration import Registration
from escape_hw.calibration.modes.bases import karhunen_loeve
from escape_hw.calibration.sprint.fit import fit_registration, sprint
from escape_hw.calibration.sprint.mode_choice import choose_modes
from escape_hw.config.loader import load_system
from escape_sim.models.factory import make_fast_model
from escape_sim.models.shack_hartmann import nominal_grid

SMALL = (
    "sensor.n_sub=12", "devices.wfs.region=[220,156,200,200]", 'devices.dm.layout="circle-7"',
    "devices.dm.pitches_across_pupil=5.0", "basis.n_modes=25", "loop.dropped_modes=0",
)  # fmt: skip
INJECTED = Registration(-16.0, 31.0, -0.77, 2.9, 0.5)


@pytest.fixture(scope="module")
def bench():
    config = load_system("razor-shwfs", overrides=SMALL)
    model = make_fast_model(config, None)
    m2c = karhunen_loeve(*model.influence_functions(), 25, 4 * config.system.pupil_m)
    return model, nominal_grid(config).valid, m2c


def measured(bench, *, noise: float, actuators: float = 0.0, slopes: float = 0.0) -> InteractionMatrix:
    model, valid, m2c = bench
    rng = np.random.default_rng(6)
    zonal_matrix = model.zonal_matrix(INJECTED) * (1 + actuators * rng.standard_normal(model.n_act))
    exact = (zonal_matrix * (1 + slopes * rng.standard_normal(len(zonal_matrix)))[:, None]) @ m2c
    sigma = np.full(exact.shape, noise * exact.std(), np.float32)
    data = (exact + sigma * rng.standard_normal(exact.shape)).astype(np.float32)
    return InteractionMatrix(data, sigma, m2c, valid, "razor-shwfs", "docrime", True)


def solve(matrix, model, **options):
    steps = fit_registration(matrix, model, **options)
    while True:
        try:
            next(steps)
        except StopIteration as done:
            return done.value


@pytest.mark.parametrize(("actuators", "slopes"), [(0.05, 0.04), (0.15, 0.02)])
def test_the_scatter_of_the_random_effects_is_learned(bench, actuators, slopes):
    fit = solve(measured(bench, noise=0.05, actuators=actuators, slopes=slopes), bench[0], update_priors=True)
    priors = fit.estimate_priors().priors
    # 37 actuators tell their scatter to an eighth, 200 slopes to a twentieth, and noise blurs both.
    assert priors.actuator_gain == pytest.approx(actuators, rel=0.45)
    assert priors.slope_gain == pytest.approx(slopes, rel=0.45)


def test_the_fitted_matrix_is_that_of_the_true_mirror(bench):
    model, _, m2c = bench
    matrix = measured(bench, noise=0.02, actuators=0.1)
    exact = measured(bench, noise=0.0, actuators=0.1).data
    fit = solve(matrix, model)
    found, nominal = fit.zonal_matrix() @ m2c, model.zonal_matrix(INJECTED) @ m2c
    assert np.linalg.norm(found - exact) < 0.01 * np.linalg.norm(exact)
    assert np.linalg.norm(nominal - exact) > 0.05 * np.linalg.norm(exact)


@pytest.mark.parametrize("solver", ["mixed-effects", "registration-only"])
def test_hubers_loss_converges_with_bad_sub_apertures(bench, solver):
    model = bench[0]
    matrix = measured(bench, noise=0.02)
    n = matrix.n_slopes // 2
    data = matrix.data.copy()
    # Rows of sub-apertures on one side that see the other: their lie has a direction.
    bad, seen = np.arange(4, 9), n - 1 - np.arange(4, 9)
    for half in (0, n):
        data[half + bad] = matrix.data[half + seen]
    spoiled = replace(matrix, data=data)
    errors = {
        loss: sprint(spoiled, model, solver=solver, loss=loss).registration.to_array() - INJECTED.to_array()
        for loss in ("squares", "huber")
    }
    unit = np.array([1.0, 1.0, 0.05, 0.2, 0.2])
    squares, huber = (np.linalg.norm(errors[loss] / unit) for loss in ("squares", "huber"))
    # Random effects alone already leave less than a third of these units.
    assert huber < max(0.7 * squares, 0.3)
    assert huber < 3


def test_informative_modes_beat_the_first_ones(bench):
    model = bench[0]
    matrix = measured(bench, noise=0.1)
    sigma = {}
    for choice in ("first", "snr", "d-optimal", "a-optimal"):
        modes = choose_modes(matrix, 6, choice, model)
        assert modes.size == 6
        sigma[choice] = sprint(matrix, model, modes=modes, solver="registration-only").sigma
    for choice in ("d-optimal", "a-optimal"):
        assert np.log(sigma[choice] / sigma["first"]).sum() < 0
    with pytest.raises(ValueError, match="pass model="):
        choose_modes(matrix, 6, "d-optimal")


@pytest.mark.parametrize("noise", [0.01, 0.1])
def test_a_matrix_without_standard_errors_gives_the_same(bench, noise):
    known = measured(bench, noise=noise, actuators=0.1, slopes=0.03)
    unknown = replace(known, sigma=np.zeros_like(known.sigma))
    one, other = (sprint(matrix, bench[0]) for matrix in (known, unknown))
    assert other.converged
    difference = other.registration.to_array() - one.registration.to_array()
    assert np.abs(difference / one.sigma).max() < 0.3
    assert other.sigma == pytest.approx(one.sigma, rel=0.5)
    # In units of its residual.
    assert other.chi2 == pytest.approx(1, abs=0.1)


def test_without_standard_errors_the_largest_columns_are_chosen(bench):
    model, valid, _ = bench
    zonal = model.zonal_matrix(INJECTED).astype(np.float32)
    matrix = InteractionMatrix(
        zonal, np.zeros_like(zonal), np.eye(model.n_act), valid, "razor-shwfs", "push-pull", True
    )
    power = np.square(zonal).sum(axis=0)
    chosen = choose_modes(matrix, 6)
    assert chosen.tolist() == sorted(chosen)
    assert power[chosen].min() >= np.delete(power, chosen).max()


def test_an_iteration_of_small_steps_that_reached_its_limit_has_not_converged(bench):
    matrix = measured(bench, noise=0.3)
    cut = sprint(matrix, bench[0], learning_rate=0.01, coarse_search=False, max_iterations=3)
    assert not cut.converged
    assert any("did not shrink" in warning for warning in cut.warnings)
    assert sprint(matrix, bench[0]).converged


def test_a_capability_under_its_former_name_is_not_ignored_silently(bench):
    class Former(type(bench[0])):
        slope_trust = np.ones(2)

    model = bench[0]
    former = object.__new__(Former)
    former.__dict__.update(getattr(model, "__dict__", {}))
    with pytest.warns(DeprecationWarning, match="slope_trust of the model 'fast' is not used"):
        sprint(measured(bench, noise=0.05), former, solver="registration-only")


@pytest.mark.parametrize("option", ["solver", "modes_choice", "loss", "actuator_model"])
def test_what_is_not_known_is_refused(bench, option):
    with pytest.raises(ValueError, match=rf"{option} is 'best'; it is one of"):
        sprint(measured(bench, noise=0.05), bench[0], **{option: "best"})


def test_telemetry_is_not_fitted_by_modes():
    from escape_hw.errors import ConfigError
    from escape_hw.runtime.session.system import open_system

    with (
        open_system("razor-shwfs", set=["calibration.solver=diagonal"]) as system,
        pytest.raises(ConfigError, match="telemetry has none"),
    ):
        system.calibrate(frames=300, estimator="telemetry")
