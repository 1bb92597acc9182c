"""The hybrid bound's information against the Jacobian written out."""

from __future__ import annotations

import numpy as np
import pytest

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.registration import Registration
from escape_hw.calibration.sprint.covariance import LowRankNoise
from escape_hw.calibration.sprint.cramer_rao_bound import compute_registration_bound, correlated_information
from escape_hw.calibration.sprint.normal_equations import Priors, normal_equations
from escape_hw.config.loader import load_system
from escape_sim.models.factory import make_fast_model
from escape_sim.models.shack_hartmann import nominal_grid

N_COMMON, N_SLOPES, N_ACT, N_MODES, N_LINES, N_TRENDS, N_KINDS = 7, 10, 5, 4, 3, 2, 3


#: 12 x 12 lenslets and 37 actuators.
SMALL = (
    "sensor.n_sub=12", "devices.wfs.region=[220,156,200,200]", 'devices.dm.layout="circle-7"',
    "devices.dm.pitches_across_pupil=5.0", "basis.n_modes=8", "loop.dropped_modes=0",
)  # fmt: skip


@pytest.fixture(scope="module")
def case():
    rng = np.random.default_rng(0)
    n = N_COMMON + N_LINES + N_TRENDS + N_KINDS * N_ACT + N_SLOPES
    return {
        "common": rng.standard_normal((N_COMMON, N_SLOPES, N_MODES)),
        "actuator_derivatives": rng.standard_normal((N_KINDS, N_SLOPES, N_ACT)),
        "modes": rng.standard_normal((N_ACT, N_MODES)),
        "model": rng.standard_normal((N_SLOPES, N_MODES)),
        "residual": rng.standard_normal((N_SLOPES, N_MODES)),
        "precision": rng.uniform(0.5, 3, n),
        "offset": np.zeros(n),
        "sampling_derivative": rng.standard_normal((N_SLOPES, N_MODES)),
        "lines": np.arange(N_SLOPES) % N_LINES,
        "trends": rng.standard_normal((N_SLOPES, N_TRENDS)),
    }


def jacobian(c):
    """Derivatives of the matrix by every unknown ``(n_unknowns, n_slopes, n_modes)``."""
    rows = list(c["common"])
    rows += [np.where((c["lines"] == k)[:, None], c["sampling_derivative"], 0.0) for k in range(N_LINES)]
    rows += [trend[:, None] * c["model"] for trend in c["trends"].T]
    rows += [np.outer(z[:, a], c["modes"][a]) for z in c["actuator_derivatives"] for a in range(N_ACT)]
    rows += [np.where((np.arange(N_SLOPES) == s)[:, None], c["model"], 0.0) for s in range(N_SLOPES)]
    return np.stack(rows)


def test_independent_slopes_give_the_solvers_own_system(case):
    system = normal_equations(**case)
    found = correlated_information(system, case["precision"], np.eye(N_SLOPES))
    np.testing.assert_allclose(found, system.matrix, atol=1e-10)


def test_correlated_slopes_count_by_the_inverse_of_their_correlation(case):
    half = np.random.default_rng(3).standard_normal((N_SLOPES, N_SLOPES))
    inverse = np.linalg.inv(half @ half.T + np.eye(N_SLOPES))
    j = jacobian(case)
    want = np.einsum("psm,st,qtm->pq", j, inverse, j) + np.diag(case["precision"])
    found = correlated_information(normal_equations(**case), case["precision"], inverse)
    np.testing.assert_allclose(found, want, atol=1e-10)


@pytest.mark.parametrize("n_rows", [30, 1000])
def test_the_inverse_from_few_rows_is_that_of_the_truth(n_rows):
    rng, p = np.random.default_rng(5), 120
    # Patterns that all slopes have the same share in.
    mirror = rng.choice([-1.0, 1.0], (p, 3)) * [9.0, 3.0, 1.0]
    shapes = np.linalg.svd(mirror, full_matrices=False)[0]
    truth = 0.8 * np.eye(p) + (shapes * [14.0, 9.0, 2.0]) @ shapes.T
    spread = np.sqrt(np.diag(truth))
    sample = rng.multivariate_normal(np.zeros(p), truth, n_rows)
    # In units of the noise, as the mirror is handed on.
    found = LowRankNoise.from_covariance(sample.T @ sample / n_rows, mirror / spread[:, None]).inverse()
    trial = rng.standard_normal((p, 40))
    correlation = truth / np.outer(spread, spread)
    want = np.einsum("pk,pk->k", trial, np.linalg.solve(correlation, trial))
    got = np.einsum("pk,pk->k", trial, found @ trial)
    assert np.mean(got / want) == pytest.approx(1.0, abs=0.08)
    # Along the strong patterns little is left of the information.
    weak = np.einsum("pk,pk->k", shapes, found @ shapes)
    assert (weak[:2] < 0.3).all()


def test_patterns_beyond_what_noise_has_are_not_seen_as_less_than_it():
    rng, p = np.random.default_rng(6), 60
    sample = rng.standard_normal((2000, p))
    noise = LowRankNoise.from_covariance(sample.T @ sample / 2000, rng.standard_normal((p, 5)))
    np.testing.assert_allclose(noise.inverse(), np.eye(p), atol=0.12)
    assert (noise.variances >= noise.level).all()


def test_the_bound_of_uncorrelated_slopes_is_the_same_by_either_way():
    config = load_system("razor-shwfs", overrides=SMALL)
    model, grid = make_fast_model(config, None), nominal_grid(config)
    rng = np.random.default_rng(7)
    m2c = np.linalg.qr(rng.standard_normal((model.n_act, 8)))[0]
    matrix = InteractionMatrix(
        (0.9 * model.zonal_matrix(Registration()) @ m2c).astype(np.float32),
        np.zeros((grid.n_slopes, 8), np.float32), m2c, grid.valid, "razor-shwfs", "docrime", True,
    )  # fmt: skip
    pokes = 0.01 * rng.standard_normal((6, 8))
    variance = rng.uniform(0.005, 0.01, grid.n_slopes)
    simple, full = (
        compute_registration_bound(matrix, pokes.T @ pokes, noise, model, Registration(), Priors())
        for noise in (variance, np.diag(variance))
    )
    np.testing.assert_allclose(simple.exact, full.exact, rtol=1e-3)
    np.testing.assert_allclose(simple.hybrid, full.hybrid, rtol=1e-3)
    # What is not known costs something, and twice the frames halve the variance of what is.
    assert (simple.hybrid > simple.exact).all()
    twice = compute_registration_bound(matrix, 2 * pokes.T @ pokes, variance, model, Registration(), Priors())
    np.testing.assert_allclose(simple.exact / twice.exact, np.sqrt(2), rtol=1e-6)
    assert (simple.hybrid / twice.hybrid < np.sqrt(2)).all()
