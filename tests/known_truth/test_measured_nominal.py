"""SPRINT with measured influence functions, or a thin plate, as the nominal mirror."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import small_pyramid
import small_system
from astropy.io import fits

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.registration import Registration
from escape_hw.api.results import RegistrationEstimate
from escape_hw.calibration.modes.bases import build_basis
from escape_hw.calibration.modes.derivatives import zonal_jacobian
from escape_hw.calibration.sprint.fit import sprint
from escape_hw.errors import ConfigError
from escape_sim.devices.bench import SimBench
from escape_sim.mirror.influence_functions import InfluenceFunctions, actuator_positions, pitch_on_pupil
from escape_sim.mirror.rounded_exponential import draw_exponential
from escape_sim.mirror.surface import InfluenceModel
from escape_sim.models.factory import make_fast_model
from escape_sim.models.pyramid import PyramidModel, nominal_pupils
from escape_sim.models.shack_hartmann import ShackHartmannModel, nominal_grid

INJECTED = Registration(-16.0, 31.0, -0.77, 1.9, 0.5)
SEEDS = range(5)
#: Noise of a matrix element relative to the rms of the matrix, and of a pixel of the maps to their peak.
NOISE, MAP_NOISE = 0.1, 0.001
CONFIG = small_system.configuration(*small_system.GAUSSIAN)
POSITIONS, PITCH = actuator_positions(CONFIG), pitch_on_pupil(CONFIG)
#: Pixels of the maps: an interferometer of 9 pixels per pitch that sees 3.6 pitches around the centre.
STEP = 9
AXIS = np.arange(-45, 46) / STEP
OUTSIDE = np.hypot(*np.meshgrid(AXIS, AXIS)) > 3.6


def gaussians(seed: int) -> InfluenceFunctions:
    rng = np.random.default_rng(seed)
    gain, width = 1 + 0.08 * rng.standard_normal(37), 1 + 0.02 * rng.standard_normal(37)
    return InfluenceFunctions(POSITIONS, PITCH, CONFIG.devices.dm.coupling, width, gain)


def exponentials(seed: int) -> InfluenceModel:
    rng = np.random.default_rng(seed)
    return draw_exponential(POSITIONS, PITCH, rng, gain_scatter=0.08, length_scatter=0.02)


def write_maps(path: Path, mirror: InfluenceModel, seed: int, **cards: Any) -> Path:
    cube = mirror.surfaces(Registration(), 1.0, AXIS * PITCH, AXIS * PITCH)
    cube += np.random.default_rng(seed).normal(0, MAP_NOISE, cube.shape)
    cube[:, OUTSIDE] = np.nan
    fits.writeto(path, cube, fits.Header(cards))
    return path


THIN_PLATE = ('devices.dm.influence="thin-plate"',)


def file_options(path: Path) -> tuple[str, ...]:
    return 'devices.dm.influence="file"', f'devices.dm.influence_file="{path}"'


@pytest.fixture(scope="module")
def nominal() -> ShackHartmannModel:
    model = make_fast_model(CONFIG, None)
    assert isinstance(model, ShackHartmannModel)
    return model


@pytest.fixture(scope="module")
def m2c(nominal: ShackHartmannModel) -> np.ndarray:
    return build_basis(CONFIG, *nominal.influence_functions(), ())


def fitted(
    sensor: ShackHartmannModel, m2c: np.ndarray, mirror: InfluenceModel, model: Any, seed: int
) -> RegistrationEstimate:
    """SPRINT on a calm, noisy matrix of a mirror that the model knows as its nominal one."""
    nodes = sensor._slopes.nodes_m
    surfaces = mirror.surfaces(INJECTED, sensor.sub_aperture_m, nodes, nodes)
    slopes = sensor._slopes.slopes(np.moveaxis(surfaces, 0, 2).copy()) * sensor._opd_per_command_m
    exact = slopes @ m2c
    sigma = np.full(exact.shape, NOISE * exact.std(), np.float32)
    data = exact + sigma * np.random.default_rng(seed + 100).standard_normal(exact.shape)
    matrix = InteractionMatrix(
        data.astype(np.float32), sigma, m2c, nominal_grid(CONFIG).valid, "small", "push-pull", True
    )
    return sprint(matrix, model)


def errors(estimates: list[RegistrationEstimate]) -> np.ndarray:
    return np.array([one.registration.to_array() - INJECTED.to_array() for one in estimates])


@pytest.mark.slow
def test_measured_functions_are_as_accurate_as_the_gaussian_family(
    nominal: ShackHartmannModel, m2c: np.ndarray, tmp_path: Path
) -> None:
    pixel_mm = 1e3 * CONFIG.devices.dm.pitch_m / STEP
    cards = {"CDELT1": pixel_mm, "CDELT2": pixel_mm, "CUNIT1": "mm", "CUNIT2": "mm", "CRPIX1": 46.0}
    cards["CRPIX2"] = 46.0
    family, measured = [], []
    for seed in SEEDS:
        family.append(fitted(nominal, m2c, gaussians(seed), nominal, seed))
        mirror = exponentials(seed)
        file = write_maps(tmp_path / f"{seed}.fits", mirror, seed, **cards)
        model = make_fast_model(small_system.configuration(*file_options(file)), None)
        measured.append(fitted(nominal, m2c, mirror, model, seed))
    assert all(one.converged for one in (*family, *measured))
    rms = [np.sqrt(np.mean(np.square(errors(each)), axis=0)) for each in (family, measured)]
    # The noise of the matrices is the same, so the ratio is far better known than either.
    scale = np.sqrt(np.mean([np.square(one.sigma) for one in family], axis=0))
    ratio = np.linalg.norm(rms[1] / scale) / np.linalg.norm(rms[0] / scale)
    assert ratio < 1.2
    pulls = errors(measured) / [one.sigma for one in measured]
    assert np.abs(pulls).max() < 4
    assert (np.mean(np.square(pulls), axis=0) < 2.5).all(), pulls


def test_the_error_of_the_place_of_the_maps_is_stated(
    nominal: ShackHartmannModel, m2c: np.ndarray, tmp_path: Path
) -> None:
    mirror = exponentials(0)
    model = make_fast_model(
        small_system.configuration(*file_options(write_maps(tmp_path / "maps.fits", mirror, 0))), None
    )
    assert isinstance(model, ShackHartmannModel)
    # Positions scatter by 0.01 pitches, of which a sub-aperture is 12 / 5.
    assert model.registration_systematic_error[:2] == pytest.approx(1.0 * 12 / 5 / np.sqrt(21), rel=0.6)
    estimate = fitted(nominal, m2c, mirror, model, 0)
    assert estimate.converged
    assert np.abs(errors([estimate])[0] / estimate.sigma).max() < 4


@pytest.mark.parametrize("shape", ["file", "thin-plate"])
def test_derivatives_of_a_pyramid_with_a_mirror_of_any_shape(shape: str, tmp_path: Path) -> None:
    config = small_pyramid.configuration(*small_system.GAUSSIAN)
    at, pitch = actuator_positions(config), pitch_on_pupil(config)
    mirror = InfluenceFunctions(at, pitch, config.devices.dm.coupling)
    reach = AXIS * pitch * 1.3
    fits.writeto(tmp_path / "maps.fits", mirror.surfaces(Registration(), 1.0, reach, reach))
    options = file_options(tmp_path / "maps.fits")
    config = small_pyramid.configuration(
        *(options if shape == "file" else ('devices.dm.influence="thin-plate"',))
    )
    model = PyramidModel(config, nominal_pupils(config))
    matrix, derivatives = zonal_jacobian(model, INJECTED, 1.05)
    assert model.zonal_matrix(INJECTED, 1.05) == pytest.approx(matrix, abs=1e-5 * np.abs(matrix).max())
    for k, step in enumerate(np.diag([1.0, 1.0, 0.02, 0.1, 0.1, 0.005])):
        point = np.append(INJECTED.to_array(), 1.05)
        above, below = (
            model.zonal_matrix(Registration.from_array(p[:5]), p[5]) for p in (point + step, point - step)
        )
        numeric = (above - below) / (2 * step.sum())
        assert np.linalg.norm(derivatives[k] - numeric) < 0.01 * np.linalg.norm(numeric)
    m2c = np.eye(model.n_act)[:, :3]
    assert model.modal_jacobian(INJECTED, m2c, 1.05)[1] == pytest.approx(derivatives @ m2c)
    if shape == "file":
        gaussian = PyramidModel(small_pyramid.configuration(*small_system.GAUSSIAN), nominal_pupils(config))
        want = gaussian.zonal_matrix(INJECTED, 1.05)
        assert np.linalg.norm(matrix - want) < 0.01 * np.linalg.norm(want)


@pytest.mark.parametrize("shape", ["file", "thin-plate"])
def test_a_twin_with_the_nominal_mirror(shape: str, tmp_path: Path) -> None:
    file = write_maps(tmp_path / "maps.fits", exponentials(3), 3)
    options = {"file": file_options(file), "thin-plate": THIN_PLATE}
    config = small_system.configuration(
        *options[shape],
        'twin.mirror.shape="nominal"',
        "twin.mirror.gain_scatter=0",
        "twin.mirror.wing_fraction=0",
    )
    model = make_fast_model(config, None)
    surfaces, _, pixel = model.influence_functions()
    assert np.median(surfaces.max(axis=(1, 2))) == pytest.approx(1.0, abs=0.1)
    x = (np.arange(surfaces.shape[2]) - (surfaces.shape[2] - 1) / 2) * pixel
    twin = SimBench(config).influence
    assert np.abs(twin.surfaces(Registration(), 1.0, x, x) - surfaces).max() < 1e-9


def test_wrong_options_are_refused() -> None:
    with pytest.raises(ConfigError, match="influence_file"):
        small_system.configuration('devices.dm.influence="file"')
    with pytest.raises(ConfigError, match=r"none\.fits cannot be read"):
        make_fast_model(small_system.configuration(*file_options(Path("none.fits"))), None)
