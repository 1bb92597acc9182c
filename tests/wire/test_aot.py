"""AOT files through aotpy: written data are read back, and its own checks pass."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from interchange_cases import lenslets, pyramid

from escape_hw.api.pyramid import PyramidPupils
from escape_hw.api.results import CalibrationResult
from escape_hw.api.sensor import SubApertureGrid
from escape_hw.errors import IncompatibleProduct, ProductError
from escape_hw.io.fits.telemetry import LoopTelemetry
from escape_hw.io.interchange.aot import ERRORS, AotSystem, read_aot, write_aot

aotpy = pytest.importorskip("aotpy", reason="needs aotpy: pip install 'escape-hw[interchange]'")
pytestmark = pytest.mark.filterwarnings("ignore::astropy.utils.exceptions.AstropyWarning")

PLACES = tuple((k * 1e-3, -k * 2e-3) for k in range(97))
FACTS = AotSystem(6.75e-3, 635e-9, 2.2e-6, PLACES, 500.0)


def telemetry(result: CalibrationResult, frames: int = 40) -> LoopTelemetry:
    rng = np.random.default_rng(0)
    index = np.cumsum(rng.integers(1, 3, frames)).astype(np.int64)
    return LoopTelemetry(
        index, (index - index[0]) / 500.0,
        rng.standard_normal((frames, result.matrix.n_slopes)).astype(np.float32),
        rng.uniform(-0.1, 0.1, (frames, 97)),
    )  # fmt: skip


@pytest.mark.parametrize("make", [lenslets, pyramid])
def test_calibration_and_telemetry_come_back(tmp_path: Path, make: Any) -> None:
    result = make()
    record = telemetry(result)
    path = write_aot(tmp_path / "run.fits", result, FACTS, record, "a = 1\n# β\n[b]\nc = 'd'\n")
    back = read_aot(path)
    assert back.system == result.matrix.system
    assert back.config_text == "a = 1\n# β\n[b]\nc = 'd'\n"
    assert back.calibration is not None
    np.testing.assert_array_equal(back.calibration.matrix.data, result.matrix.data)
    np.testing.assert_array_equal(back.calibration.matrix.sigma, result.matrix.sigma)
    np.testing.assert_allclose(back.calibration.matrix.m2c, result.matrix.m2c, rtol=1e-12)
    assert back.calibration.matrix.simulated
    assert back.calibration.matrix.method == "docrime"
    assert back.calibration.frames == result.frames
    np.testing.assert_array_equal(back.geometry.valid, result.grid.valid)
    np.testing.assert_allclose(back.geometry.flux, result.grid.flux)
    if isinstance(result.grid, SubApertureGrid):
        assert isinstance(back.geometry, SubApertureGrid)
        assert back.geometry.origin_px == result.grid.origin_px
        assert back.geometry.pitch_px == result.grid.pitch_px
        np.testing.assert_array_equal(back.geometry.references_px, result.grid.references_px)
    else:
        assert isinstance(back.geometry, PyramidPupils)
        np.testing.assert_array_equal(back.geometry.corners_px, result.grid.corners_px)
        np.testing.assert_array_equal(back.geometry.centres_px, result.grid.centres_px)
        assert back.geometry.mean_low_orders == pytest.approx(result.grid.mean_low_orders)
    assert back.telemetry is not None
    np.testing.assert_array_equal(back.telemetry.index, record.index)
    np.testing.assert_array_equal(back.telemetry.slopes, record.slopes)
    np.testing.assert_allclose(back.telemetry.commands, record.commands, rtol=1e-12)
    np.testing.assert_allclose(back.telemetry.exposed_s, record.exposed_s)
    assert back.telemetry.rate_hz == pytest.approx(500)


def test_the_file_passes_the_packages_own_verification(tmp_path: Path) -> None:
    result = lenslets()
    path = write_aot(tmp_path / "run.fits", result, FACTS, telemetry(result))
    aotpy.io.verify_file(path)
    system = aotpy.AOSystem.read_from_file(path)
    sensor, loop = system.wavefront_sensors[0], system.loops[0]
    assert sensor.n_valid_subapertures == result.grid.n_valid
    assert sensor.measurements.data.shape == (40, 2, result.grid.n_valid)
    assert loop.modes_to_measurements.data.shape == (result.grid.n_valid, 2, 94)
    # The standard's commands are metres of surface.
    assert np.abs(loop.commands.data).max() < 0.1 * 2.2e-6
    assert system.wavefront_correctors[0].stroke == 2.2e-6
    x = loop.modes_to_measurements.data[7, 0, 3]
    assert x == result.matrix.data[7, 3], "x of sub-aperture 7, mode 3"


def test_a_file_that_is_not_ours_is_read_by_the_standard_alone(tmp_path: Path) -> None:
    """Another order of sub-apertures, no metadata, an interaction matrix instead of a modal one."""
    result = lenslets(n_modes=20)
    path = write_aot(tmp_path / "ours.fits", result, FACTS)
    system = aotpy.AOSystem.read_from_file(path)
    sensor, loop = system.wavefront_sensors[0], system.loops[0]
    n = result.grid.n_valid
    turn = np.random.default_rng(1).permutation(n)
    mask = sensor.subaperture_mask.data.copy()
    mask[mask >= 0] = turn
    back = np.argsort(turn)
    sensor.subaperture_mask = aotpy.Image("MASK", mask)
    sensor.ref_measurements = aotpy.Image("REF", sensor.ref_measurements.data[:, back])
    sensor.subaperture_intensities = None
    loop.interaction_matrix = aotpy.Image("IM", loop.modes_to_measurements.data[back])
    loop.modes_to_measurements = loop.modes_to_commands = None
    system.loops, system.metadata, system.config = [loop], [], None
    system.write_to_file(tmp_path / "foreign.fits")
    found = read_aot(tmp_path / "foreign.fits")
    assert found.calibration is not None
    np.testing.assert_array_equal(found.calibration.matrix.data, result.matrix.data)
    np.testing.assert_array_equal(found.calibration.matrix.m2c, np.eye(20))
    assert not found.calibration.matrix.sigma.any()
    assert isinstance(found.geometry, SubApertureGrid)
    assert isinstance(result.grid, SubApertureGrid)
    np.testing.assert_allclose(found.geometry.centres_px(), result.grid.centres_px())
    np.testing.assert_array_equal(found.geometry.references_px, result.grid.references_px)
    assert found.telemetry is None


def test_what_cannot_be_is_refused_with_a_message(tmp_path: Path) -> None:
    result = lenslets()
    record = telemetry(result)
    wrong = replace(record, slopes=record.slopes[:, :-2])
    with pytest.raises(IncompatibleProduct, match="belong to different calibrations"):
        write_aot(tmp_path / "run.fits", result, FACTS, wrong)
    assert not list(tmp_path.iterdir())
    with pytest.raises(ProductError, match="cannot be read"):
        read_aot(tmp_path / "none.fits")
    (tmp_path / "text.fits").write_text("hello")
    with pytest.raises(ProductError, match="not an AOT file"):
        read_aot(tmp_path / "text.fits")
    path = write_aot(tmp_path / "run.fits", result, FACTS, record)
    with pytest.raises(IncompatibleProduct, match="It has: LOOP"):
        read_aot(path, loop="OTHER")
    assert ERRORS not in read_aot(path).system
