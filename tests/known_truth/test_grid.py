"""The lenslet grid is located at any position, and refused where there is none."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import special
from sensor_frames import N_PIX, WAVELENGTH, flat, pupil_amplitude, sensor

from escape_hw.calibration.acquisition.sensor_setup import find_darkest_pixels
from escape_hw.config import layouts
from escape_hw.errors import CalibrationError
from escape_hw.pipeline.geometry.lenslet_grid import _without_hot_pixels, find_lenslet_grid
from escape_sim.atmosphere.phase_plates import RotatingScreen, von_karman_screen

PITCH_TOLERANCE = 1e-3
ORIGIN_TOLERANCE = 0.1
#: Lenslets, nominal pitch, region, beam radius in pupil radii.
SENSORS = {
    "bench": (24, 15.54, (400, 400), 1.48),
    "uniform light": (24, 15.54, (400, 410), np.inf),
    "narrow beam": (24, 15.54, (400, 400), 0.8),
    "few lenslets": (6, 15.54, (130, 130), np.inf),
    "odd number": (13, 15.54, (240, 235), 1.48),
    "whole pixels": (10, 8.0, (110, 112), 1.48),
}


def find(frame, n_sub=24, nominal=15.54, **options):
    return find_lenslet_grid(
        frame, n_sub=n_sub, nominal_pitch_px=nominal, **{"threshold": 20.0, "min_flux": 0.5, **options}
    )


def assert_found(grid, pitch, origin, tolerance=ORIGIN_TOLERANCE):
    assert grid.pitch_px == pytest.approx(pitch, rel=PITCH_TOLERANCE)
    assert grid.origin_px == pytest.approx(origin, abs=tolerance)


@pytest.mark.parametrize("case", SENSORS)
@pytest.mark.parametrize("seed", range(4))
def test_pitch_and_origin_are_recovered(case, seed):
    n_sub, nominal, shape, beam = SENSORS[case]
    rng = np.random.default_rng(seed)
    pitch = nominal * rng.uniform(0.98, 1.02)
    optics, origin = sensor(n_sub, pitch, tuple(rng.uniform(-0.4, 0.4, 2) * nominal), shape, beam)
    grid = find(flat(optics), n_sub, nominal)
    assert_found(grid, pitch, origin)
    assert not grid.references_px.any()


def test_a_beam_beside_the_pupils_middle_does_not_renumber_the_lenslets():
    optics, origin = sensor(24, 15.55, (3.2, -1.7), (400, 400))
    # The brightest spot stands at a third of the radius from the middle, the dimmest has a sixth of it.
    x = (np.arange(400) - 199.5) / (12 * 15.55)
    light = np.exp(-2 * ((x[None, :] - 0.33) ** 2 + (x[:, None] + 0.2) ** 2) / 1.45**2)
    assert_found(find(flat(optics) * light), 15.55, origin)


@pytest.mark.parametrize("peak", [120.0, 250.0, 700.0])
def test_hot_pixels_do_not_matter(peak):
    optics, origin = sensor(24, 15.49, (-4.1, 2.6), (400, 400), 1.48)
    frame = flat(optics, peak)
    clean = find(frame)
    rng = np.random.default_rng(1)
    frame[rng.integers(0, 400, 12), rng.integers(0, 400, 12)] = 1023
    # One in the corner, far outside the pupil.
    frame[3, 5] = 1023
    grid = find(frame)
    assert_found(grid, 15.49, origin)
    assert grid.counts == pytest.approx(clean.counts, rel=0.2)


def test_noise_does_not_matter():
    optics, origin = sensor(24, 15.6, (0.3, 5.2), (400, 400), 1.48)
    rng = np.random.default_rng(2)
    frame = flat(optics, 300.0)
    # Far more than a mean of 200 frames has.
    assert_found(find(rng.poisson(frame) + rng.normal(0, 5, frame.shape)), 15.6, origin)


@pytest.mark.parametrize(("r0_m", "tolerance"), [(0.7e-3, ORIGIN_TOLERANCE), (0.307e-3, 0.2)])
def test_the_mean_of_turbulent_frames_will_do(r0_m, tolerance):
    # What remains is the mean tilt and focus of the turbulence over the frames.
    optics, origin = sensor(24, 15.55, (3.2, -1.7), (400, 400), 1.48)
    n, pixel = 24 * N_PIX, 6.75e-3 / (24 * N_PIX)
    phase = von_karman_screen(2048, pixel, r0_m, 30e-3, np.random.default_rng(3))
    plate = RotatingScreen(phase * np.float32(WAVELENGTH / (2 * np.pi)), pixel, 28e-3, pupil_amplitude(n) > 0)
    total = np.zeros((400, 400), np.float32)
    for k in range(60):
        opd = np.zeros((n, n), np.float32)
        plate.add(k * 2.93e-3, opd)
        optics.frame(opd, total)
    assert_found(find(total * (600 / total.max())), 15.55, origin, tolerance)


def test_mean_references_are_the_mean_spots():
    optics, origin = sensor(24, 15.55, (3.2, -1.7), (400, 400), 1.48)
    n = 24 * N_PIX
    # A weak astigmatism: its slopes grow linearly, with opposite signs along x and y.
    line = (np.arange(n) - (n - 1) / 2) / (n / 2)
    opd = np.asarray(0.3e-6 * (line[None, :] ** 2 - line[:, None] ** 2), dtype=np.float32)
    image = optics.frame(opd)
    image *= 700 / image.max()
    grid = find(image, references="mean")
    rows, columns = np.nonzero(grid.valid)
    # d(opd)/dx over one lenslet in waves times lambda/d in pixels.
    slope = 2 * 0.3e-6 * (2 / 24) / WAVELENGTH * 2.3
    want = slope * np.stack([(columns - 11.5) / 12, -(rows - 11.5) / 12], axis=1)
    assert grid.origin_px == pytest.approx(origin, abs=ORIGIN_TOLERANCE)
    assert np.vdot(grid.references_px, want) / np.vdot(want, want) == pytest.approx(1, abs=0.1)
    # The pixels that the windows cut off make up the rest.
    assert np.std(grid.references_px - want) < 0.03
    assert np.std(want) > 0.06


def test_valid_sub_apertures_follow_the_light():
    optics, _ = sensor(24, 15.55, (0.0, 0.0), (400, 400), 1.48)
    frame = flat(optics)
    half, most = find(frame, min_flux=0.5), find(frame, min_flux=0.2)
    assert half.n_valid < most.n_valid
    assert (most.valid | ~half.valid).all()
    assert (half.flux[half.valid] >= 0.5).all()
    line = np.arange(24) - 11.5
    assert (np.hypot(line[:, None], line)[half.valid] < 12.5).all()
    # Twice the light makes twice the counts and the same grid.
    bright = find(2 * frame, threshold=40.0)
    assert bright.counts == pytest.approx(2 * half.counts, rel=1e-5)
    assert (bright.valid == half.valid).all()


def test_configured_sub_apertures_are_valid_whatever_the_light():
    optics, _ = sensor(24, 15.55, (3.2, -1.7), (400, 400), 1.48)
    valid = layouts.layout_map("rows:" + ",".join(["0", "10", *["14"] * 20, "10", "0"]))
    valid = np.pad(valid, ((0, 0), (5, 5)))
    frame = flat(optics)
    grid, lit = find(frame, valid=valid), find(frame)
    assert np.array_equal(grid.valid, valid)
    assert grid.references_px.shape == (300, 2)
    assert (grid.origin_px, grid.pitch_px) == (lit.origin_px, lit.pitch_px)
    valid[23, :2] = True
    with pytest.raises(CalibrationError, match=r"2 of the 302 .* are dark .* row 23, column 0"):
        find(frame, valid=valid)


@pytest.mark.parametrize("level", [0.0, 19.0])
def test_no_light_is_an_error(level):
    with pytest.raises(CalibrationError, match="no light above the threshold"):
        find(np.full((400, 400), level, np.float32))


def noise() -> np.ndarray:
    return np.abs(np.random.default_rng(4).normal(0, 15, (400, 400)))


def uniform() -> np.ndarray:
    return np.full((400, 400), 300.0)


def one_hot_pixel() -> np.ndarray:
    frame = np.zeros((400, 400))
    frame[201, 190] = 1023
    return frame


def one_spot() -> np.ndarray:
    line = np.arange(400) - 200
    return 900 * np.exp(-(line[:, None] ** 2 + line**2) / 30**2)


@pytest.mark.parametrize("make", [noise, uniform, one_hot_pixel, one_spot])
def test_light_without_a_lattice_is_an_error(make):
    with pytest.raises(CalibrationError):
        find(make().astype(np.float32))


@pytest.mark.parametrize(
    "ratio",
    [
        0.95,
        1.06,
        2.0,
        *(pytest.param(r, marks=pytest.mark.slow) for r in (1 / 3, 0.5, 0.9, 1.04, 1.1, 1.2, 1.5, 3.0)),
    ],
)
def test_a_wrong_design_pitch_is_an_error(ratio):
    optics, _ = sensor(24, 15.55, (3.2, -1.7), (400, 400), 1.48)
    with pytest.raises(CalibrationError, match=r"sensor\.pitch_px"):
        find(flat(optics), nominal=15.55 * ratio)


def test_an_unknown_choice_of_references_is_an_error():
    with pytest.raises(ValueError, match="references"):
        find(uniform(), references="middle")


def test_a_dark_sub_aperture_with_a_hot_pixel_stays_dark():
    optics, origin = sensor(24, 15.49, (-4.1, 2.6), (400, 400), 1.48)
    frame = flat(optics, 250.0)
    clean = find(frame)
    # In the corner of the grid and just outside the pupil: nothing but a hot pixel in either.
    dark = [(0, 0), (2, 4), (23, 12)]
    assert not any(clean.valid[at] for at in dark)
    for (row, column), level in zip(dark, (1023, 1023, 300), strict=True):
        x, y = origin[0] + column * 15.49, origin[1] + row * 15.49
        # One of them bright enough to hold more light than any spot.
        assert level > 250
        frame[round(y) + 3, round(x) - 2] += level
    grid = find(frame)
    assert (grid.valid == clean.valid).all()
    assert grid.counts == pytest.approx(clean.counts, rel=0.01)


@pytest.mark.parametrize("spot_px", [0.5, *(pytest.param(px, marks=pytest.mark.slow) for px in (1.0, 2.3))])
def test_sharp_spots_are_not_taken_for_hot_pixels(spot_px):
    at, sigma = 20.3 + 15.49 * np.arange(24), spot_px / 2.355
    edges = (np.arange(401)[:, None] - 0.5 - at) / sigma
    comb = np.diff(special.ndtr(edges), axis=0).sum(axis=1)
    frame = 700 * np.outer(comb, comb) / comb.max() ** 2
    assert np.array_equal(_without_hot_pixels(frame, 24), frame)
    grid = find(frame.astype(np.float32))
    assert grid.valid.all()
    assert_found(grid, 15.49, (20.3, 20.3))


def test_where_every_lenslet_is_lit_the_background_is_that_between_the_spots():
    # Seven lenslets of seven pixels, the whole camera.
    at = (np.arange(49) % 7 - 3.0) / 1.1
    frame = (100 + 4000 * np.exp(-(at[:, None] ** 2 + at**2) / 2)).astype(np.float32)
    between = frame.ravel()[find_darkest_pixels(frame, 4)]
    assert 100 <= np.median(between) < 140


def test_light_below_the_background_is_an_error():
    frame = np.full((49, 49), -1000.0, np.float32)
    frame[3::7, 3::7] = 500.0
    with pytest.raises(CalibrationError, match="brighter than the background"):
        find_lenslet_grid(frame, n_sub=7, nominal_pitch_px=7.0, threshold=30.0, min_flux=0.3)
