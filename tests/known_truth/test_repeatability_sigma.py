"""The uncertainty of differences between runs: noise without the model error that all runs share."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from small_matrices import CONFIG, GRID, MODEL, measured

from escape_hw.api.results import CalibrationResult, RegistrationEstimate
from escape_hw.calibration.sprint.fit import sprint
from escape_hw.io import documents
from escape_hw.io.fits.matrix import load_matrix, save_matrix
from escape_hw.report import comparison, tables
from escape_hw.runtime.session.record import config_provenance


@cache
def fitted(seed: int, tilt: float = 0.0) -> RegistrationEstimate:
    return sprint(measured(seed, tilt), MODEL)


def between_runs(estimate: RegistrationEstimate) -> NDArray[np.float64]:
    sigma = estimate.repeatability_sigma
    assert sigma is not None
    return sigma


def test_runs_of_a_set_up_agree_within_their_repeatability():
    runs = [fitted(seed) for seed in range(5)]
    values = np.array([one.registration.to_array() for one in runs])
    sigma = np.mean([between_runs(one) for one in runs], axis=0)
    chi2 = values.var(axis=0, ddof=1) / sigma**2
    assert 0.3 < chi2.mean() < 2.0, chi2
    # The places of the actuators are the same in all runs; what the registration of such a mirror means is
    # uncertain by more.
    assert (sigma < 0.5 * runs[0].sigma).all()


@pytest.mark.slow
def test_noise_common_to_a_column_counts():
    assert (between_runs(fitted(0, 1.0)) > 1.5 * between_runs(fitted(0))).any()


def test_a_known_covariance_of_the_noise_is_used():
    n = GRID.n_slopes
    correlated = np.eye(n) + 0.5 * np.kron(np.eye(2), np.ones((n // 2, n // 2)))
    white, common = (
        between_runs(sprint(measured(0), MODEL, covariance=covariance))
        for covariance in (np.eye(n), correlated)
    )
    assert np.isfinite(white).all()
    assert not np.allclose(white, common, rtol=1e-3)


def test_it_is_stored_shown_and_compared(tmp_path):
    results = [
        CalibrationResult(measured(seed), GRID, 0, 0, 0.0, registration=fitted(seed)) for seed in range(2)
    ]
    path = tmp_path / "im.fits"
    save_matrix(path, results[0], config_provenance(CONFIG))
    restored = load_matrix(path).registration
    assert restored is not None
    np.testing.assert_allclose(between_runs(restored), between_runs(fitted(0)))
    assert documents.registration_document(restored)["repeatability_sigma"]["rotation"] > 0
    assert "± between runs" in tables.registration_table({"": restored}).headings
    compared = comparison.compare(*results)
    assert comparison.registration_table(compared).headings[-1] == "change / σ"
    assert not compared.changed_actuators
    change = compared.between_runs["rotation"]
    assert abs(change.value) < 4 * change.sigma < 4 * compared.registration["rotation"].sigma


def test_an_actuator_with_another_gain_is_named():
    first = 0.08 * np.random.default_rng(0).normal(size=37)
    second = 1.01 * (1 + first) * (1 + 0.004 * np.random.default_rng(1).normal(size=37)) - 1
    second[23] = 1.3 * (1 + second[23]) - 1
    changed = comparison.changed_gains(first, second)
    assert list(changed) == [23]
    assert 0.27 < changed[23] < 0.33
