"""Dark frame and flat of the sensor's camera: their file, and the keys that name it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from small_system import configuration

from escape_hw.calibration.acquisition.sensor_setup import find_sensor, measure_dark, measure_flat
from escape_hw.errors import CalibrationError, ConfigError, ProductError
from escape_hw.io.fits.pixels import load_pixels
from escape_hw.io.run_folder import RunFolder
from escape_hw.runtime.procedures.detector import DarkProcedure
from escape_hw.runtime.session.record import BenchRecord
from escape_hw.runtime.session.system import System


@pytest.fixture(scope="module")
def dark_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dark frame as `escape dark` saves it."""
    with System.from_config(configuration()) as bench:
        procedure = DarkProcedure(frames=20)
        result = bench.run(procedure)
        with RunFolder("razor-shwfs", "dark", tmp_path_factory.mktemp("dark") / "run") as folder:
            procedure.save(folder, BenchRecord.from_bench(bench), result, 1.0)
    return folder.file("dark.fits")


def test_a_configured_dark_frame_is_subtracted(dark_file: Path) -> None:
    dark = load_pixels(dark_file, "DARK").result
    with System.from_config(configuration(f'devices.wfs.dark_file="{dark_file}"')) as bench:
        assert bench.dark is not None
        np.testing.assert_array_equal(bench.dark, dark)
        setup = bench.run(find_sensor(bench, frames=20))
        slopes = bench.slopes_of(setup.grid)
    assert setup.grid.background == 0
    np.testing.assert_array_equal(slopes.dark, dark)


def test_a_flat_can_be_measured_in_another_run_than_the_dark_frame(dark_file: Path) -> None:
    wanted = pytest.raises(CalibrationError, match=r"wfs\.dark_file")
    with System.from_config(configuration()) as bench, wanted:
        bench.run(measure_flat(bench, frames=2))
    # Light on lenslets is not uniform, which is told after the dark frame was subtracted.
    wanted = pytest.raises(CalibrationError, match="uniform light")
    with System.from_config(configuration(f'devices.wfs.dark_file="{dark_file}"')) as bench, wanted:
        bench.run(measure_flat(bench, frames=2))


@pytest.mark.parametrize(
    ("key", "more", "message"),
    [
        ("flat_file", (), "flat_file.*DARK"),
        ("dark_file", ("devices.wfs.region=[220,156,190,200]",), "200 x 200 pixels, .* 190 x 200"),
    ],
)
def test_a_wrong_file_is_refused_with_its_key(
    dark_file: Path, key: str, more: tuple[str, ...], message: str
) -> None:
    config = configuration(f'devices.wfs.{key}="{dark_file}"', *more)
    with pytest.raises(ConfigError, match=message):
        System.from_config(config)


def test_a_missing_file_is_named() -> None:
    with pytest.raises(ConfigError, match=r"wfs\.dark_file: nowhere/dark\.fits"):
        System.from_config(configuration('devices.wfs.dark_file="nowhere/dark.fits"'))


def test_a_damaged_file_is_refused(dark_file: Path, tmp_path: Path) -> None:
    content = bytearray(dark_file.read_bytes())
    content[-3000] ^= 0xFF
    copy = tmp_path / "dark.fits"
    copy.write_bytes(content)
    with pytest.raises(ProductError):
        load_pixels(copy, "DARK")


def test_without_a_beam_stop_the_key_is_named() -> None:
    config = configuration()
    devices = config.devices.model_copy(update={"screen": None})
    wanted = pytest.raises(CalibrationError, match=r"devices\.wfs\.dark_file")
    with System.from_config(config.model_copy(update={"devices": devices})) as bench, wanted:
        bench.run(measure_dark(bench, frames=2))
