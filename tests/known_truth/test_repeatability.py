"""The uncertainty of differences between runs: noise without the model error that all runs share."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
from numpy.typing import NDArray
from small_system import configuration

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.registration import Registration
from escape_hw.api.results import CalibrationResult, RegistrationEstimate
from escape_hw.calibration.sprint.fit import sprint
from escape_hw.config.layouts import layout_map
from escape_hw.io import documents
from escape_hw.io.fits.matrix import load_matrix, save_matrix
from escape_hw.io.interchange.arrays import design_geometry
from escape_hw.report import comparison, tables
from escape_hw.runtime.session.array_target import array_target
from escape_hw.runtime.session.record import config_provenance
from escape_sim.models.factory import make_fast_model

CONFIG = configuration()
GRID = design_geometry(layout_map("circle-12"), array_target(CONFIG))
MODEL = make_fast_model(CONFIG, GRID)
NOISE = 0.02
TRUTH = Registration(10.0, -8.0, 0.5, 1.0, -1.0)


@cache
def true_matrix() -> NDArray[np.float64]:
    """A mirror with a ring around each of its actuators, which have places and gains of their own."""
    rng = np.random.default_rng(4)
    columns = []
    for actuator, (x, y) in enumerate(5 * rng.normal(size=(MODEL.n_act, 2))):
        at = replace(TRUTH, shift_x=TRUTH.shift_x + x, shift_y=TRUTH.shift_y + y)
        columns.append((MODEL.zonal_matrix(at) + 0.2 * MODEL.zonal_matrix(at, 2.2))[:, actuator])
    return np.stack(columns, axis=1) * (1 + 0.05 * rng.normal(size=MODEL.n_act))


@cache
def measured(seed: int, tilt: float = 0.0) -> InteractionMatrix:
    """The matrix with noise, and with a wavefront of its own in every column."""
    rng, true = np.random.default_rng(seed), true_matrix()
    data = true + NOISE * rng.normal(size=true.shape)
    if tilt:
        rows, columns = np.argwhere(GRID.valid).T / GRID.valid.shape[0] - 0.5
        focus, astigmatism = np.concatenate([columns, rows]), np.concatenate([rows, columns])
        data += tilt * (np.outer(focus, rng.normal(size=37)) + np.outer(astigmatism, rng.normal(size=37)))
    return InteractionMatrix(
        data.astype(np.float32), np.full(data.shape, NOISE, np.float32), np.eye(37), GRID.valid,
        CONFIG.system.name, "push-pull", True, slope_unit=GRID.slope_unit,
    )  # fmt: skip


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
    change = compared.between_runs["rotation"]
    assert abs(change.value) < 4 * change.sigma < 4 * compared.registration["rotation"].sigma
