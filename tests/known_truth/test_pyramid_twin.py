"""The small pyramid twin from frames to a closed loop, its products and its report."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_pyramid import configuration, small, true_centres

from escape_hw.api.modulator import Modulation
from escape_hw.api.pyramid import PyramidPupils
from escape_hw.api.results import CalibrationResult
from escape_hw.errors import CalibrationError, IncompatibleProduct, ProductError
from escape_hw.io.fits.matrix import load_matrix, save_matrix
from escape_hw.report.comparison import compare
from escape_hw.report.figures import bench as figures_bench
from escape_hw.report.figures import matrix as figures_matrix
from escape_hw.runtime.session.record import BenchRecord
from escape_hw.runtime.session.system import System

TURN_S = 66 * 50e-6


@pytest.fixture(scope="module")
def bench() -> Iterator[System]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("escape_sim.optics.detector.Detector.POOL", 1 << 19)
        with small("twin.loss_probability=0") as opened:
            yield opened


@pytest.fixture(scope="module")
def baseline(bench: System) -> CalibrationResult:
    return bench.calibrate("push-pull", frames=10)


@pytest.fixture(scope="module")
def measured(bench: System) -> CalibrationResult:
    return bench.calibrate("docrime", frames=1500)


def pupils_of(result: CalibrationResult) -> PyramidPupils:
    assert isinstance(result.grid, PyramidPupils)
    return result.grid


# -- devices ----------------------------------------------------------------------------------


def test_devices_open_with_the_modulator_parked_and_close_parked() -> None:
    with small() as one:
        assert [device.name for device in one.devices] == ["dm", "wfs", "modulator", "science", "screen"]
        assert one.modulator is not None
        assert one.modulator.modulation is None
        assert one.simulated
        one.find_sensor(frames=10)
        assert one.modulator.modulation is not None
        assert BenchRecord.from_bench(one).serials["modulator"] == "SIMMOD"
    assert one.modulator.modulation is None


def test_camera_exposes_whole_cycles_and_continues_its_count() -> None:
    with small("twin.loss_probability=0") as one:
        assert one.modulator is not None
        assert one.wfs.settings.frame_rate_hz == 300.0
        before = [one.wfs.next_frame(1.0) for _ in range(3)]
        started = one.wfs.now_ns()
        turning = one.modulator.modulate(Modulation(1.4e-4, 303.0))
        assert one.wfs.now_ns() - started >= 0.2e9
        assert turning.frequency_hz == pytest.approx(1 / TURN_S)
        settings = one.wfs.settings
        assert settings.exposure_s == pytest.approx(TURN_S)
        assert settings.frame_rate_hz == pytest.approx(1 / TURN_S)
        during = [one.wfs.next_frame(1.0) for _ in range(4)]
        assert np.diff([frame.exposed_ns for frame in during]) == pytest.approx(TURN_S * 1e9)
        one.modulator.park()
        after = [one.wfs.next_frame(1.0) for _ in range(2)]
        index = [frame.index for frame in (*before, *during, *after)]
        assert index == list(range(index[0], index[0] + 9))
        slow = one.wfs.configure(replace(one.wfs.settings, frame_rate_hz=100.0, exposure_s=9e-3))
        assert slow.frame_rate_hz == 100.0
        one.modulator.modulate(Modulation(1.4e-4, 303.0))
        assert one.wfs.settings.frame_rate_hz == pytest.approx(1 / (3 * TURN_S))


def test_a_parked_modulator_leaves_the_beam_on_the_tip() -> None:
    still = ("twin.vibration.amplitude_rad=[0.0, 0.0]", "twin.pyramid.drift=0")
    with small(*still) as one:
        assert one.screen is not None
        assert one.modulator is not None
        one.screen.set(inserted=False)
        grid = one.find_sensor(frames=10).grid
        assert isinstance(grid, PyramidPupils)
        positions = one.dm.info.positions_m[:, 0]
        tilts = {}
        for radius in (3.0, 0.0):
            if not radius:
                one.modulator.park()
            slopes_of = one.slopes_of(replace(grid, modulation=radius))
            means = []
            for sign in (1, -1):
                one.dm.send(sign * 2e-3 * positions / np.abs(positions).max())
                frames = [one.wfs.next_frame(1.0) for _ in range(12)][4:]
                means.append(np.mean([slopes_of(frame.data)[: grid.n_valid] for frame in frames]))
            tilts[radius] = means[0] - means[1]
    # The same tilt; a beam that rests on the tip sees several times as much of it.
    assert tilts[0.0] > 2 * tilts[3.0] > 0.004


# -- procedures -------------------------------------------------------------------------------


def test_pupils_are_found_where_they_are(
    bench: System, baseline: CalibrationResult, measured: CalibrationResult
) -> None:
    for result, bound in ((baseline, 0.1), (measured, 0.2)):
        pupils = pupils_of(result)
        assert np.sqrt(np.mean(np.square(pupils.centres_px - true_centres(bench)))) < bound
        assert pupils.diameter_px == pytest.approx(16, abs=1.5)
        assert pupils.modulation == pytest.approx(3.0)
        assert result.matrix.slope_unit == "1"
    assert pupils_of(measured).motion > 2 * pupils_of(baseline).motion


def test_docrime_sees_the_same_modes_through_turbulence_but_weaker(
    baseline: CalibrationResult, measured: CalibrationResult
) -> None:
    found = compare(baseline, measured)
    assert np.median(found.correlation) > 0.9
    assert 0.15 < np.median(found.gain_ratio) < 0.6
    assert measured.response is not None
    assert 1.5 < measured.response.delay_frames < 2.6


def test_loop_closes_with_either_matrix(
    bench: System, baseline: CalibrationResult, measured: CalibrationResult
) -> None:
    psf = bench.take_model_psf(frames=5)
    gain = float(np.median(compare(baseline, measured).gain_ratio))
    for result, scale in ((baseline, 1.0), (measured, gain)):
        run = bench.close_loop(result.matrix, result.grid, gain=0.5 * scale, frames=400, model_psf=psf)
        assert run.stable
        assert run.rate_hz == pytest.approx(1 / TURN_S, rel=0.03)
        assert run.strehl is not None
        assert run.strehl.peak.value > 0.3


def test_pupils_of_another_modulation_are_refused(bench: System, baseline: CalibrationResult) -> None:
    other = replace(pupils_of(baseline), modulation=5.0)
    with pytest.raises(IncompatibleProduct, match=r"modulation of 5 lambda/D, the modulator does 3"):
        bench.close_loop(baseline.matrix, other, frames=10)


def test_darkness_is_noticed(bench: System, baseline: CalibrationResult) -> None:
    assert bench.screen is not None
    bench.screen.set(blocked=True)
    try:
        with pytest.raises(CalibrationError, match="no light on most pupil pixels"):
            bench.close_loop(baseline.matrix, baseline.grid, frames=100)
        with pytest.raises(CalibrationError, match="no pupil images"):
            bench.find_sensor(frames=20)
    finally:
        bench.screen.set(blocked=False)


# -- products ---------------------------------------------------------------------------------


def test_product_gives_back_every_part_of_the_pupils(measured: CalibrationResult, tmp_path: Path) -> None:
    product = load_matrix(save_matrix(tmp_path / "im.fits", measured), expect_sensor="pyramid")
    before, after = pupils_of(measured), pupils_of(product.result)
    for name in ("centres_px", "corners_px", "valid", "references", "flux"):
        one, two = getattr(before, name), getattr(after, name)
        assert np.array_equal(one, two), name
        assert one.dtype == two.dtype, name
    for name in ("diameter_px", "counts", "motion", "background", "normalisation", "modulation"):
        assert getattr(before, name) == getattr(after, name), name
    assert product.matrix.slope_unit == "1"
    assert np.array_equal(product.matrix.data, measured.matrix.data)


def test_product_of_a_pyramid_is_not_for_lenslets(measured: CalibrationResult, tmp_path: Path) -> None:
    path = save_matrix(tmp_path / "im.fits", measured)
    with pytest.raises(IncompatibleProduct, match="kind of sensor is 'pyramid'; 'shack-hartmann' is needed"):
        load_matrix(path, expect_sensor="shack-hartmann")


def test_product_of_an_unknown_kind_is_refused(
    measured: CalibrationResult, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from escape_hw.io.fits import extensions as fits_geometry

    monkeypatch.setitem(fits_geometry._CARDS, "curvature", fits_geometry._CARDS["pyramid"])
    monkeypatch.setattr(PyramidPupils, "kind", "curvature")
    path = save_matrix(tmp_path / "im.fits", measured)
    monkeypatch.undo()
    with pytest.raises(ProductError, match="kind 'curvature'; this version reads shack-hartmann, pyramid"):
        load_matrix(path)


def test_frames_and_modes_are_drawn(measured: CalibrationResult) -> None:
    assert measured.mean_frame is not None
    figure = figures_bench.sensor_frame(measured.mean_frame, measured.grid)
    axes = figure.axes[0]
    assert "four images of" in axes.get_title()
    circles = [patch for patch in axes.patches if hasattr(patch, "radius")]
    assert len(circles) == 4
    assert {round(2 * circle.radius, 6) for circle in circles} == {round(pupils_of(measured).diameter_px, 6)}
    assert len(figures_matrix.mode_maps({"DO-CRIME": measured.matrix}).axes) > 2


def test_configuration_without_a_screen_or_science_camera_opens() -> None:
    config = configuration()
    devices = config.devices.model_copy(update={"screen": None, "science": None})
    with System.from_config(config.model_copy(update={"devices": devices})) as one:
        assert one.find_sensor(frames=10).grid.n_valid > 150
