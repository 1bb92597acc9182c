"""Influence functions that SPRINT has found: surfaces, product, command, and nominal mirror of a next run."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import small_system
from command_line import document, escape
from test_measured_nominal import CONFIG, INJECTED, exponentials, fitted

from escape_hw.api.influence import InfluenceEstimate
from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.registration import Registration
from escape_hw.api.results import CalibrationResult, RegistrationEstimate
from escape_hw.calibration.modes.bases import build_basis
from escape_hw.calibration.sprint.influence_estimate import estimate_influence_functions
from escape_hw.calibration.sprint.synthetic_matrix import compute_fitted_matrix
from escape_hw.errors import CalibrationError, ProductError
from escape_hw.io.fits.influence import load_influence, save_influence
from escape_hw.io.fits.matrix import load_matrix, save_matrix
from escape_hw.report.content import read_product
from escape_hw.report.run_report import render_page
from escape_hw.runtime.session.record import config_provenance
from escape_sim.models.factory import make_fast_model
from escape_sim.models.shack_hartmann import ShackHartmannModel, nominal_grid

__all__ = ["document", "escape"]

SEED = 1


@pytest.fixture(scope="module")
def model() -> ShackHartmannModel:
    made = make_fast_model(CONFIG, None)
    assert isinstance(made, ShackHartmannModel)
    return made


@pytest.fixture(scope="module")
def m2c(model: ShackHartmannModel) -> np.ndarray:
    return build_basis(CONFIG, *model.influence_functions(), ())


@pytest.fixture(scope="module")
def estimate(model: ShackHartmannModel, m2c: np.ndarray) -> RegistrationEstimate:
    return fitted(model, m2c, exponentials(SEED), model, SEED)


@pytest.fixture(scope="module")
def found(model: ShackHartmannModel, estimate: RegistrationEstimate) -> InfluenceEstimate:
    return estimate_influence_functions(model, estimate)


@pytest.fixture
def product(
    estimate: RegistrationEstimate, m2c: np.ndarray, model: ShackHartmannModel, tmp_path: Path
) -> Path:
    grid = nominal_grid(CONFIG)
    matrix = small_matrix(compute_fitted_matrix(model, estimate.registration, estimate, m2c), m2c, grid)
    result = CalibrationResult(matrix, grid, 10, 0, 1.0, registration=estimate)
    return save_matrix(tmp_path / "im.fits", result, config_provenance(CONFIG))


def small_matrix(data: np.ndarray, m2c: np.ndarray, grid: Any) -> Any:
    sigma = np.full(data.shape, 0.01, np.float32)
    return InteractionMatrix(
        data.astype(np.float32), sigma, m2c, grid.valid, CONFIG.system.name, "escape", True
    )


def in_the_pupil(found: InfluenceEstimate, surfaces: np.ndarray) -> np.ndarray:
    """Heights over the pupil without the mean of each actuator, which the sensor does not see."""
    lit = np.hypot(*np.meshgrid(found.x_m, found.y_m)) < 2.5 * found.pitch_m
    heights = surfaces[:, lit]
    return np.asarray(heights - heights.mean(axis=1, keepdims=True))


def test_surfaces_are_those_of_the_mirror(model: ShackHartmannModel, found: InfluenceEstimate) -> None:
    mirror = exponentials(SEED)
    true = in_the_pupil(found, mirror.surfaces(Registration(), 1.0, found.x_m, found.y_m))
    fitted_surfaces = in_the_pupil(found, found.surfaces)
    nominal = model.surface_model(found.x_m, found.y_m).zonal_matrix(Registration()).T
    guess = in_the_pupil(found, nominal.reshape(found.surfaces.shape))
    left, before = (
        np.linalg.norm(one * np.vdot(one, true) / np.vdot(one, one) - true)
        for one in (fitted_surfaces, guess)
    )
    assert left < 0.25 * before
    assert found.sigma.shape == found.surfaces.shape
    assert 0 < found.sigma.max() < 0.2


def test_profile_with_errors(found: InfluenceEstimate) -> None:
    mirror, profile = exponentials(SEED), found.profile
    rounding, length = mirror.rounding[0], np.median(mirror.length)
    true = np.exp(-(np.hypot(profile.radius, rounding) - rounding) / length)
    assert np.abs(profile.fitted - true).max() < 0.03
    assert np.abs(profile.nominal - true).max() > 0.1
    assert profile.fitted[0] == pytest.approx(1.0, abs=1e-6)
    assert profile.sigma[0] == pytest.approx(0.0, abs=1e-6)
    assert (profile.sigma[5:] > 0).all()
    assert profile.edge.shape == profile.edge_sigma.shape == profile.radius.shape
    assert profile.edge[0] == pytest.approx(1.1, abs=0.1)


def test_a_fit_without_influence_functions_is_refused(
    model: ShackHartmannModel, estimate: RegistrationEstimate
) -> None:
    with pytest.raises(CalibrationError, match="solver = 'mixed-effects'"):
        estimate_influence_functions(model, replace(estimate, actuator_corrections=None))


def test_the_product_is_read_back(found: InfluenceEstimate, tmp_path: Path) -> None:
    path = save_influence(tmp_path / "influence.fits", found, "small", True, 2.0)
    read = load_influence(path).result
    assert read.surfaces == pytest.approx(found.surfaces, abs=1e-6)
    assert read.x_m == pytest.approx(2 * found.x_m)
    assert read.positions_m == pytest.approx(2 * found.positions_m)
    assert read.positions_sigma_m == pytest.approx(2 * found.positions_sigma_m)
    assert read.place_sigma == pytest.approx(found.place_sigma * [2, 2, 1, 1, 1])
    assert read.pitch_m == pytest.approx(2 * found.pitch_m)
    assert np.array_equal(read.edge, found.edge)
    assert read.profile.fitted == pytest.approx(found.profile.fitted)
    with pytest.raises(ProductError, match="kind"):
        load_matrix(path)


@pytest.mark.slow
def test_the_registration_keeps_its_profile_on_disk(product: Path, estimate: RegistrationEstimate) -> None:
    read = load_matrix(product).registration
    assert read is not None
    for one, other in zip(
        (read.influence_profile.edge, read.actuator_corrections.shape_covariance,
         read.actuator_corrections.position_sigma, read.actuator_corrections.width_sigma),
        (estimate.influence_profile.edge, estimate.actuator_corrections.shape_covariance,
         estimate.actuator_corrections.position_sigma, estimate.actuator_corrections.width_sigma),
        strict=True,
    ):  # fmt: skip
        assert one == pytest.approx(other)
    assert "Influence functions that SPRINT has found" in render_page(read_product(product))


def test_what_was_found_is_the_nominal_mirror_of_the_next_run(
    product: Path, escape: Any, document: Any, model: ShackHartmannModel, m2c: np.ndarray, tmp_path: Path
) -> None:
    file = tmp_path / "influence.fits"
    code, told, _ = document("influence", product, "--out", file)
    assert code == 0
    assert told["products"]["influence"] == str(file)
    assert len(told["profile"]["radius"]) == 41
    assert document("show", file)[1]["n_act"] == 37
    assert "at 1.0 pitches" in escape("show", file)[1]
    mirror = exponentials(SEED)
    config = small_system.configuration('devices.dm.influence="file"', f'devices.dm.influence_file="{file}"')
    again = make_fast_model(config, None)
    first = fitted(model, m2c, mirror, model, SEED + 7)
    second = fitted(model, m2c, mirror, again, SEED + 7)
    assert second.converged
    # The shape is found, so that less is left to fit, and the registration is the same.
    pull = (second.registration.to_array() - INJECTED.to_array()) / second.sigma
    assert np.abs(pull).max() < 4
    assert np.linalg.norm(second.actuator_corrections.gain) < 0.5 * np.linalg.norm(
        first.actuator_corrections.gain
    )
    change = [
        np.abs(one.influence_profile.fitted - one.influence_profile.nominal).max() for one in (first, second)
    ]
    assert change[1] < 0.3 * change[0]


def test_a_matrix_without_a_fit_is_refused(product: Path, document: Any, tmp_path: Path) -> None:
    bare = replace(load_matrix(product).result, registration=None)
    path = save_matrix(tmp_path / "bare.fits", bare, config_provenance(CONFIG))
    code, told, _ = document("influence", path, "--out", tmp_path / "x.fits")
    assert code == 2
    assert "has no registration" in told["error"]["message"]


def test_a_fit_that_did_not_converge_is_not_written(
    product: Path, estimate: RegistrationEstimate, document: Any, tmp_path: Path
) -> None:
    failed = replace(estimate, converged=False, warnings=("the steps did not shrink",))
    path = save_matrix(
        tmp_path / "im.fits", replace(load_matrix(product).result, registration=failed),
        config_provenance(CONFIG),
    )  # fmt: skip
    code, told, _ = document("influence", path, "--out", tmp_path / "x.fits")
    assert code == 1
    assert "did not converge: the steps did not shrink" in told["error"]["message"]
    assert not (tmp_path / "x.fits").exists()


@pytest.mark.parametrize(
    "fits", [False, *(pytest.param(fits, marks=pytest.mark.slow) for fits in (True, None))]
)
def test_a_model_that_does_not_fit_is_said_where_the_file_is_used(
    found: InfluenceEstimate, fits: bool | None, caplog: pytest.LogCaptureFixture, escape: Any, tmp_path: Path
) -> None:
    file = save_influence(tmp_path / "influence.fits", replace(found, model_fits=fits), "small", True)
    assert load_influence(file).result.model_fits is fits
    assert ("model did not fit" in escape("show", file)[1]) is (fits is False)
    config = small_system.configuration('devices.dm.influence="file"', f'devices.dm.influence_file="{file}"')
    for _ in range(2):
        make_fast_model(config, None)
    said = [one for one in caplog.messages if "model did not fit" in one]
    assert len(said) == (fits is False)


@pytest.mark.parametrize(
    ("simulated", "mode"),
    [(True, "hardware"), (False, "hardware"), pytest.param(True, "sim", marks=pytest.mark.slow)],
)
def test_influence_functions_of_a_twin_are_told_from_those_of_a_real_mirror(
    found: InfluenceEstimate, simulated: bool, mode: str, caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    file = save_influence(tmp_path / "influence.fits", found, "small", simulated)
    config = small_system.configuration(
        'devices.dm.influence="file"', f'devices.dm.influence_file="{file}"', f'devices.dm.mode="{mode}"'
    )
    make_fast_model(config, None)
    said = [one for one in caplog.messages if "made on a twin" in one]
    assert len(said) == (simulated and mode == "hardware")
