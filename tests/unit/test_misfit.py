"""SPRINT's normal equations against the Jacobian written out."""

from __future__ import annotations

import numpy as np
import pytest

from escape_hw.calibration.sprint.normal_equations import normal_equations

N_COMMON, N_SLOPES, N_ACT, N_MODES, N_KINDS = 7, 11, 6, 5, 3


@pytest.fixture(scope="module", params=(0, 2), ids=("even", "trends"))
def case(request):
    rng, n_trends = np.random.default_rng(0), request.param
    n = N_COMMON + n_trends + N_KINDS * N_ACT + N_SLOPES
    return {
        "common": rng.standard_normal((N_COMMON, N_SLOPES, N_MODES)),
        "actuator_derivatives": rng.standard_normal((N_KINDS, N_SLOPES, N_ACT)),
        "modes": rng.standard_normal((N_ACT, N_MODES)),
        "model": rng.standard_normal((N_SLOPES, N_MODES)),
        "residual": rng.standard_normal((N_SLOPES, N_MODES)),
        "precision": rng.uniform(0.5, 3, n),
        "offset": rng.standard_normal(n),
        "trends": rng.standard_normal((N_SLOPES, n_trends)),
    }


def jacobian(c):
    """Derivatives of the matrix by every unknown ``(n_slopes * n_modes, n_unknowns)``."""
    columns = list(c["common"])
    columns += [trend[:, None] * c["model"] for trend in c["trends"].T]
    for zonal in c["actuator_derivatives"]:
        columns += [np.outer(zonal[:, a], c["modes"][a]) for a in range(N_ACT)]
    for s in range(N_SLOPES):
        one = np.zeros((N_SLOPES, N_MODES))
        one[s] = c["model"][s]
        columns.append(one)
    return np.stack([column.ravel() for column in columns], axis=1)


def test_the_system_is_that_of_the_dense_jacobian(case):
    j = jacobian(case)
    system = normal_equations(**case)
    assert system.matrix == pytest.approx(j.T @ j + np.diag(case["precision"]), abs=1e-10)
    assert system.right_hand_side == pytest.approx(
        j.T @ case["residual"].ravel() - case["precision"] * case["offset"], abs=1e-10
    )
    assert system.n_common == N_COMMON


def test_its_solution_is_the_penalised_least_squares(case):
    system = normal_equations(**case)
    # Priors as additional data: each unknown measured once, with its prior's precision.
    root = np.sqrt(case["precision"])
    design = np.concatenate([jacobian(case), np.diag(root)])
    data = np.concatenate([case["residual"].ravel(), -root * case["offset"]])
    want = np.linalg.lstsq(design, data, rcond=None)[0]
    assert np.linalg.solve(system.matrix, system.right_hand_side) == pytest.approx(want, abs=1e-9)


def test_the_callers_arrays_stay_as_they_were(case):
    before = {name: values.copy() for name, values in case.items()}
    normal_equations(**case).projected_jacobian()
    assert all(np.array_equal(case[name], before[name]) for name in case)


def test_projected_derivatives_are_orthogonal_to_the_random_effects(case):
    system = normal_equations(**case)
    j, k = jacobian(case), N_COMMON
    common, random = j[:, :k], j[:, k:]
    prior = np.diag(case["precision"][k:])
    imitation = np.linalg.solve(random.T @ random + prior, random.T @ common)
    want = (common - random @ imitation).T.reshape(k, N_SLOPES, N_MODES)
    assert system.projected_jacobian() == pytest.approx(want, abs=1e-10)


def test_without_priors_they_are_orthogonal_to_every_random_effect(case):
    # A vague prior binds nothing: what remains is the projection.
    vague = {**case, "precision": np.full_like(case["precision"], 1e-9)}
    vague["modes"] = np.random.default_rng(1).standard_normal((N_ACT, 40))
    rng = np.random.default_rng(2)
    for name in ("model", "residual"):
        vague[name] = rng.standard_normal((N_SLOPES, 40))
    vague["common"] = rng.standard_normal((N_COMMON, N_SLOPES, 40))
    left = normal_equations(**vague).projected_jacobian()
    for a in range(N_ACT):
        for zonal in vague["actuator_derivatives"]:
            effect = np.outer(zonal[:, a], vague["modes"][a])
            assert np.einsum("psm,sm->p", left, effect) == pytest.approx(np.zeros(N_COMMON), abs=1e-6)
    for trend in vague["trends"].T:
        effect = trend[:, None] * vague["model"]
        assert np.einsum("psm,sm->p", left, effect) == pytest.approx(np.zeros(N_COMMON), abs=1e-6)
    assert np.einsum("psm,sm->ps", left, vague["model"]) == pytest.approx(
        np.zeros((N_COMMON, N_SLOPES)), abs=1e-6
    )


def test_information_on_the_common_parameters_is_that_of_the_projected_derivatives(case):
    # Schur complement of the system == efficient scores' squares plus what the priors add.
    system, k = normal_equations(**case), N_COMMON
    a, b, c = system.matrix[:k, :k], system.matrix[:k, k:], system.matrix[k:, k:]
    reduced = a - b @ np.linalg.solve(c, b.T)
    imitation = np.linalg.solve(c, b.T)
    left = system.projected_jacobian().reshape(k, -1)
    priors = imitation.T @ (case["precision"][k:, None] * imitation) + np.diag(case["precision"][:k])
    assert left @ left.T + priors == pytest.approx(reduced, abs=1e-9)


@pytest.mark.parametrize(("together", "want"), [(0.0, 1.0), (1.0, 40.0), (0.5, 20.5)])
def test_noise_that_slopes_share_does_not_average_out(together, want):
    # Each actuator moves all of 40 slopes alike: shared noise has 40 times the variance in their sum.
    rng, n_slopes, n_modes = np.random.default_rng(4), 40, 4000
    common, own = rng.standard_normal((1, n_modes)), rng.standard_normal((n_slopes, n_modes))
    alike = np.ones((n_slopes, N_ACT))
    system = normal_equations(
        rng.standard_normal((N_COMMON, n_slopes, n_modes)),
        np.stack([alike] * N_KINDS),
        rng.standard_normal((N_ACT, n_modes)),
        rng.standard_normal((n_slopes, n_modes)),
        np.sqrt(together) * common + np.sqrt(1 - together) * own,
        np.ones(N_COMMON + N_KINDS * N_ACT + n_slopes),
        np.zeros(N_COMMON + N_KINDS * N_ACT + n_slopes),
    )
    assert system.estimate_noise_inflation() == pytest.approx(want, rel=0.1)
