"""Keys of the twin for what a drawing gets wrong: each does to frames or signals what it says."""

from __future__ import annotations

import numpy as np
import pytest
import small_pyramid
from numpy.typing import NDArray
from small_system import configuration

from escape_hw.api.modulator import Modulation
from escape_hw.config.loader import load_system
from escape_hw.config.sensor import PyramidSection
from escape_hw.config.system import SystemConfig
from escape_hw.errors import ConfigError
from escape_hw.pipeline.geometry.pupil_images import find_pupil_images
from escape_hw.pipeline.slopes.pyramid import slopes_of_image
from escape_sim.devices.bench import SimBench
from escape_sim.models.pyramid import nominal_pupils
from escape_sim.optics.pupil import pupil_geometry
from escape_sim.optics.pyramid import PyramidOptics
from escape_sim.optics.sensor import make_sensor_optics
from escape_sim.optics.shack_hartmann import ShackHartmannOptics

#: A grid that is nominal except for what a case changes.
SQUARE = ("twin.wfs.grid_offset_px=[0,0]", "twin.wfs.pitch_px=15.54")
CENTRED = "twin.pyramid.centre_offsets_px=[[0,0],[0,0],[0,0],[0,0]]"
ROUND = (CENTRED, "twin.pyramid.ellipse=0.0", "twin.pyramid.phase=0.0")
#: Half a pixel per lenslet in waves.
TILT = 0.5 / 2.3


def lenslet_image(config: SystemConfig, waves: tuple[float, float] = (0.0, 0.0)) -> NDArray[np.floating]:
    """Noiseless image of a wavefront whose slopes are ``waves`` (x, y) per lenslet."""
    pupil = pupil_geometry(config)
    at = pupil.coordinates_m / pupil.sub_aperture_m * config.system.wavelength_m
    tilt = (waves[0] * at)[None, :] + (waves[1] * at)[:, None]
    return make_sensor_optics(config, pupil).frame(tilt.astype(np.float32))


def spots(image: NDArray[np.floating], centres: NDArray[np.float64]) -> NDArray[np.float64]:
    """Centres of gravity ``(n, 2)`` as (x, y) in boxes of 9 pixels around ``centres (n, 2)``."""
    found = []
    for x, y in np.round(centres).astype(int):
        box = image[y - 4 : y + 5, x - 4 : x + 5].astype(float)
        line = np.arange(-4, 5)
        found.append((x + (box.sum(0) @ line) / box.sum(), y + (box.sum(1) @ line) / box.sum()))
    return np.array(found)


def square_grid(config: SystemConfig) -> NDArray[np.float64]:
    """Offsets ``(n, 2)`` from the middle of the grid, in pixels, of lenslets well inside the pupil."""
    n = config.sensor.n_sub
    line = (np.arange(n) - (n - 1) / 2) * config.sensor.pitch_px
    offsets = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    return np.asarray(offsets[np.hypot(*offsets.T) < 0.4 * n * config.sensor.pitch_px])


MIDDLE = np.array([99.5, 99.5])


def test_a_clocked_grid_and_its_spots_turn() -> None:
    config = configuration(*SQUARE, "twin.wfs.clocking_deg=2.0")
    c, s = np.cos(np.deg2rad(2.0)), np.sin(np.deg2rad(2.0))
    turn = np.array([[c, -s], [s, c]])
    expected = MIDDLE + square_grid(config) @ turn.T
    flat = spots(lenslet_image(config), expected)
    assert np.abs(flat - expected).max() < 0.03
    moved = spots(lenslet_image(config, (TILT, 0.0)), expected) - flat
    assert moved.mean(axis=0) == pytest.approx(0.5 * turn[:, 0], abs=0.02)
    moved = spots(lenslet_image(config, (0.0, TILT)), expected) - flat
    assert moved.mean(axis=0) == pytest.approx(0.5 * turn[:, 1], abs=0.02)


def test_distortion_displaces_spots_with_the_cube_of_the_distance() -> None:
    config = configuration(*SQUARE, "twin.wfs.distortion=0.03")
    offsets = square_grid(config)
    half_width = config.sensor.n_sub * config.sensor.pitch_px / 2
    expected = MIDDLE + offsets * (1 + 0.03 * (np.hypot(*offsets.T)[:, None] / half_width) ** 2)
    assert np.abs(expected - MIDDLE - offsets).max() > 1.0
    assert np.abs(spots(lenslet_image(config), expected) - expected).max() < 0.03


def test_a_grid_that_is_hardly_clocked_gives_the_frame_of_a_square_one() -> None:
    square, clocked = (configuration(f"twin.wfs.clocking_deg={angle}") for angle in (0.0, 1e-7))
    assert isinstance(make_sensor_optics(square, pupil_geometry(square)), ShackHartmannOptics)
    one, other = (lenslet_image(config, (TILT, -TILT)) for config in (square, clocked))
    assert np.abs(one - other).max() < 1e-5 * one.max()


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        (("twin.wfs.clocking_deg=1.0", "system.optics=oopao"), "needs system.optics = 'fast'"),
        (("twin.wfs.clocking_deg=11.0",), "twin.wfs.clocking_deg"),
        (("twin.pyramid.diameter_px=12.0",), "is not used with sensor.kind = 'shack-hartmann'"),
    ],
)
def test_lenslets_refuse(keys: tuple[str, ...], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        configuration(*keys)


@pytest.mark.parametrize(
    ("key", "message"),
    [
        ("twin.wfs.distortion=0.01", "applies to lenslets"),
        ("twin.pyramid.diameter_px=20.0", "differs from sensor.n_sub = 16 by more than 10%"),
    ],
)
def test_a_pyramid_refuses(key: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        small_pyramid.configuration(key)


def test_a_clocked_grid_outside_the_region_is_refused() -> None:
    config = configuration("twin.wfs.clocking_deg=10.0", "twin.wfs.grid_offset_px=[4.0,0.0]")
    with pytest.raises(ValueError, match=r"reduce twin\.wfs\.clocking_deg"):
        SimBench(config).sensor()


def test_true_stroke_scales_the_mirror() -> None:
    nominal, larger = (SimBench(configuration(*keys)) for keys in ((), ("twin.mirror.stroke_m=2.42e-6",)))
    command = np.zeros(37)
    command[18] = 0.3
    assert larger.mirror_opd(command) == pytest.approx(1.1 * nominal.mirror_opd(command), rel=1e-5)


def test_beam_radius_and_centre_are_seen_in_the_flux_of_the_spots() -> None:
    radius, x, y = 4.0e-3, 0.6e-3, -0.3e-3
    keys = (f"twin.beam.radius_m={radius}", f"twin.beam.centre_m=[{x},{y}]")
    config = configuration(*SQUARE, *keys)
    bench, uniform = SimBench(config), SimBench(configuration(*SQUARE))
    frames = [b.sensor().frame(np.zeros(b.pupil.amplitude.shape, np.float32)) for b in (bench, uniform)]
    offsets = square_grid(config)
    boxes = np.round(MIDDLE + offsets).astype(int)
    flux = np.array([[f[j - 6 : j + 7, i - 6 : i + 7].sum() for i, j in boxes] for f in frames])
    # The logarithm of a Gaussian is a parabola: its terms give radius and centre.
    u, v = (offsets / config.sensor.pitch_px * bench.pupil.sub_aperture_m).T
    terms = np.stack([u**2 + v**2, u, v, np.ones_like(u)], axis=1)
    a, b, c, _ = np.linalg.lstsq(terms, np.log(flux[0] / flux[1]), rcond=None)[0]
    found = np.sqrt(-2 / a)
    assert found == pytest.approx(radius, rel=0.02)
    assert (-b / (2 * a), -c / (2 * a)) == pytest.approx((x, y), abs=2e-5)
    assert bench.wfs_light(1e-3)[0] == uniform.wfs_light(1e-3)[0], "the light of the pupil is the same"


def quiet(*keys: str) -> SystemConfig:
    return small_pyramid.configuration(
        *ROUND, *keys, "twin.vibration.amplitude_rad=[0,0]", "twin.ncpa.rms_m=0", "twin.wfs.fixed_pattern=0"
    )


def test_pupil_images_have_the_true_diameter() -> None:
    found = []
    for diameter in (63.0, 65.0):
        config = load_system("razor-pywfs", overrides=[*ROUND, f"twin.pyramid.diameter_px={diameter}"])
        twin, sensor = SimBench(config), config.sensor_as(PyramidSection)
        image = 1e6 * modulated(config).frame(np.zeros(twin.pupil.amplitude.shape, np.float32))
        found.append(find_pupil_images(image, n_sub=64, nominal_px=np.array(sensor.pupils_px), min_flux=0.25))
        # A shift by one sub-aperture is one camera pixel, whatever the diameter.
        assert config.system.pupil_m / twin.pupil.sub_aperture_m == pytest.approx(diameter)
    # Diffraction at the rim adds to both.
    assert found[1].diameter_px - found[0].diameter_px == pytest.approx(2.0, abs=0.2)
    assert np.abs(found[1].centres_px - found[0].centres_px).max() < 0.1


def modulated(config: SystemConfig) -> PyramidOptics:
    """The true optics with the nominal modulation commanded."""
    bench, modulator = SimBench(config), config.devices.modulator
    assert modulator is not None
    bench.beam_path.modulation = Modulation(3.0 * modulator.rad_per_lambda_d, 303.0)
    optics = bench.sensor()
    assert isinstance(optics, PyramidOptics)
    return optics


def tilt_slope(config: SystemConfig, axis: int) -> float:
    """Mean slope along an axis for a small tilt along it."""
    optics, pupil, pupils = modulated(config), pupil_geometry(config), nominal_pupils(config)
    line = pupil.coordinates_m / config.system.pupil_m * config.system.wavelength_m * 0.05
    tilt = np.broadcast_to(line[None, :] if axis == 0 else line[:, None], (line.size, line.size))
    up, down = (slopes_of_image(optics.frame((sign * tilt).astype(np.float32)), pupils) for sign in (1, -1))
    return float(np.split((up - down) / 2, 2)[axis].mean())


def test_a_larger_modulation_lowers_the_slopes() -> None:
    nominal, larger = (tilt_slope(quiet(f"twin.pyramid.radius_error={e}"), 0) for e in (0.0, 0.2))
    # A geometric pyramid's slope is in proportion to 1 / radius.
    assert larger / nominal == pytest.approx(1 / 1.2, rel=0.05)


def test_the_ellipse_turns() -> None:
    def slopes(angle: float) -> tuple[float, float]:
        keys = ("twin.pyramid.ellipse=0.2", f"twin.pyramid.ellipse_angle_deg={angle}")
        return tilt_slope(quiet(*keys), 0), tilt_slope(quiet(*keys), 1)

    x, y = slopes(0.0)
    assert x / y == pytest.approx(0.9 / 1.1, rel=0.05)
    assert slopes(90.0) == pytest.approx((y, x), rel=0.04), "from other points of the path"
    x, y = slopes(45.0)
    assert x == pytest.approx(y, rel=0.04)


@pytest.mark.parametrize("angle", [45.0, -45.0])
def test_a_diagonal_ellipse_dwells_on_two_faces(angle: float) -> None:
    config = quiet("twin.pyramid.ellipse=0.2", f"twin.pyramid.ellipse_angle_deg={angle}")
    image = modulated(config).frame(np.zeros(pupil_geometry(config).amplitude.shape, np.float32))
    halves = image[:32, :32].sum() + image[32:, 32:].sum(), image[:32, 32:].sum() + image[32:, :32].sum()
    # The phase between x and y differs from 90 degrees by twice the arc tangent of 0.1.
    lag = 2 * np.rad2deg(np.arctan(0.1))
    along, across = halves if angle > 0 else halves[::-1]
    assert along / across == pytest.approx((90 + lag) / (90 - lag), rel=0.1)


def test_substeps_average_the_turbulence_over_the_exposure() -> None:
    keys = ("devices.screen.speed_m_s=0.5", "twin.vibration.amplitude_rad=[0,0]", "twin.mirror.settling_s=0")
    bench = SimBench(configuration(*keys, "twin.substeps=4"))
    image, _ = bench.wfs_image(0.0, 2e-3)
    single = SimBench(configuration(*keys, "twin.substeps=1"))
    parts = [single.wfs_image(k * 5e-4, (k + 1) * 5e-4)[0] for k in range(4)]
    assert np.abs(image - np.mean(parts, axis=0)).max() < 1e-5 * image.max()
    assert np.abs(image - parts[1]).max() > 0.05 * image.max()


#: New keys at the values that they have by default.
NOMINAL = {
    "lenslets": (
        "razor-shwfs", "twin.wfs.clocking_deg=0", "twin.wfs.distortion=0", "twin.mirror.stroke_m=2.2e-6",
        "twin.beam.radius_m=inf", "twin.beam.centre_m=[0,0]",
    ),
    "pyramid": (
        "razor-pywfs", "twin.pyramid.diameter_px=16", "twin.pyramid.radius_error=0",
        "twin.pyramid.ellipse_angle_deg=0", "twin.mirror.stroke_m=2.2e-6",
    ),
}  # fmt: skip


@pytest.mark.parametrize("sensor", NOMINAL)
def test_nominal_values_change_no_bit(sensor: str) -> None:
    make = configuration if sensor == "lenslets" else small_pyramid.configuration
    one, other = (SimBench(make(*keys)).wfs_image(0.0, 1e-3)[0] for keys in ((), NOMINAL[sensor][1:]))
    np.testing.assert_array_equal(one, other)
