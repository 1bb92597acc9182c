"""The twin's Shack-Hartmann optics are OOPAO's, and a plain Fourier transform's."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from sensor_frames import turbulence

from escape_hw.api.sensor import SubApertureGrid
from escape_hw.pipeline.slopes.shack_hartmann import ShackHartmannSlopes
from escape_sim.oopao.library import make_lenslets, make_source, oopao_classes, suppress_output
from escape_sim.oopao.optics import OOPAOShackHartmann, trigonometric_interpolation
from escape_sim.optics.shack_hartmann import ShackHartmannOptics

WAVELENGTH = 635e-9
N_SUB, N_PIX = 10, 8
N = N_SUB * N_PIX
#: Single precision of the fast optics, relative to the brightest pixel.
FRAME_TOLERANCE = 1e-6
#: The same in slopes, in pixels (spots are 2.3 pixels wide).
SLOPE_TOLERANCE = 2e-5


def gaussian_pupil() -> NDArray[np.float32]:
    y, x = np.indices((N, N)) - (N - 1) / 2
    r2 = x**2 + y**2
    return np.where(r2 <= (N / 2) ** 2, np.exp(-r2 / (0.75 * N) ** 2), 0).astype(np.float32)


PATHS = {
    "flat": np.zeros((N, N), np.float32),
    "weak": turbulence(N, 50e-9, seed=1),
    "strong": turbulence(N, 700e-9, seed=2),
}


def tilt(x_waves: float, y_waves: float) -> NDArray[np.float32]:
    """Path that moves spots by so many lambda/d."""
    y, x = (np.indices((N, N)) - (N - 1) / 2) / N_PIX * WAVELENGTH
    return (x_waves * x + y_waves * y).astype(np.float32)


@pytest.fixture(scope="module")
def own_geometry():
    """OOPAO's own detector: 16 whole pixels per lenslet, two per lambda/d; nothing is resampled."""
    pupil = gaussian_pupil()
    light = make_source(pupil, 1.0, WAVELENGTH)
    sensor = make_lenslets(light, N_SUB, 2 * N_PIX)
    side = N_SUB * 2 * N_PIX
    fast = ShackHartmannOptics(
        N_SUB, N_PIX, WAVELENGTH, 2 * N_PIX, 2.0, (N_PIX - 0.5, N_PIX - 0.5), (side, side), pupil
    )
    return light, sensor, fast


def oopao_frame(light, sensor, opd):
    with suppress_output():
        light.source**light.telescope * oopao_classes().OPD_map(opd.astype(float)) * sensor
    size = 2 * N_PIX
    tiles = np.asarray(sensor.cam.frame).reshape(N_SUB, size, N_SUB, size) / light.photons_per_unit
    # OOPAO lays each lenslet's image down with x along its rows.
    return tiles.transpose(0, 3, 2, 1).reshape(N_SUB * size, N_SUB * size)


@pytest.mark.parametrize("path", PATHS)
def test_frames_equal_those_of_oopao(own_geometry, path):
    light, sensor, fast = own_geometry
    theirs = oopao_frame(light, sensor, PATHS[path])
    ours = fast.frame(PATHS[path])
    assert theirs.max() > 0.1
    assert np.abs(ours - theirs).max() < FRAME_TOLERANCE * theirs.max()


@pytest.mark.parametrize("path", PATHS)
def test_slopes_equal_those_of_oopao(own_geometry, path):
    light, sensor, fast = own_geometry
    oopao_frame(light, sensor, PATHS[path])
    theirs = np.asarray(sensor.signal_2D).reshape(2, N_SUB, N_SUB)
    lit = np.asarray(sensor.sh_data["src_0"].valid_subapertures)
    frames = [fast.frame(opd) for opd in (PATHS["flat"], PATHS[path])]
    half = N_PIX - 0.5
    grid = SubApertureGrid(
        2.0 * N_PIX, (half, half), lit, np.zeros((int(lit.sum()), 2), np.float32), lit.astype(np.float32)
    )
    extractor = ShackHartmannSlopes(grid, frames[0].shape)
    flat, moved = (extractor(frame) for frame in frames)
    assert np.abs((moved - flat).reshape(2, -1) - theirs[:, lit]).max() < SLOPE_TOLERANCE


@pytest.mark.parametrize("path", PATHS)
def test_frames_equal_a_plain_fourier_transform(path):
    # A second route that shares nothing with OOPAO or with the matrix transform: zero padding such
    # that one FFT bin is one camera pixel (20 bins for 8 samples: lambda/d = 2.5 pixels).
    pupil, bins = gaussian_pupil(), 20
    side = N_SUB * bins
    fast = ShackHartmannOptics(
        N_SUB, N_PIX, WAVELENGTH, bins, bins / N_PIX, (bins // 2, bins // 2), (side + 1, side + 1), pupil
    ).frame(PATHS[path])
    field = pupil * np.exp(2j * np.pi * PATHS[path].astype(float) / WAVELENGTH)
    want = np.zeros((side + 1, side + 1))
    for i in range(N_SUB):
        for j in range(N_SUB):
            part = field[i * N_PIX : (i + 1) * N_PIX, j * N_PIX : (j + 1) * N_PIX]
            spot = np.abs(np.fft.fftshift(np.fft.fft2(part, (bins, bins)))) ** 2 / bins**2
            # Pixel 0 of the shifted image lies half an image before the lenslet's centre; the
            # fast optics begin one pixel later and so see that pixel at the far edge.
            spot = np.roll(spot, (-1, -1), axis=(0, 1))
            want[i * bins + 1 : (i + 1) * bins + 1, j * bins + 1 : (j + 1) * bins + 1] += spot
    assert np.abs(fast - want).max() < FRAME_TOLERANCE * want.max()


@pytest.fixture(scope="module")
def bench_geometry():
    """Pitch, spot size and offset of the bench: nothing is a whole number."""
    args = (N_SUB, N_PIX, WAVELENGTH, 15.55, 2.3, (12.3, 14.7), (170, 175), gaussian_pupil())
    return ShackHartmannOptics(*args), OOPAOShackHartmann(*args)


@pytest.mark.parametrize("path", PATHS)
def test_the_twin_sees_the_same_frames_with_oopao_inside(bench_geometry, path):
    fast, slow = bench_geometry
    ours, theirs = fast.frame(PATHS[path]), slow.frame(PATHS[path])
    assert ours.shape == theirs.shape == (170, 175)
    assert np.abs(ours - theirs).max() < FRAME_TOLERANCE * theirs.max()


@pytest.mark.parametrize("path", PATHS)
def test_the_twin_sees_the_same_slopes_with_oopao_inside(bench_geometry, path):
    fast, slow = bench_geometry
    valid = (gaussian_pupil() ** 2).reshape(N_SUB, N_PIX, N_SUB, N_PIX).sum(axis=(1, 3)) > 20
    grid = SubApertureGrid(
        15.55, (12.3, 14.7), valid, np.zeros((int(valid.sum()), 2), np.float32), valid.astype(np.float32)
    )
    extractor = ShackHartmannSlopes(grid, (170, 175))
    difference = extractor(fast.frame(PATHS[path])) - extractor(slow.frame(PATHS[path]))
    assert valid.sum() > 40
    assert np.abs(difference).max() < SLOPE_TOLERANCE


@pytest.mark.parametrize("make", [ShackHartmannOptics, OOPAOShackHartmann])
@pytest.mark.parametrize("waves", [(0.5, 0.0), (0.0, 0.5), (-0.4, 0.3)])
def test_a_positive_slope_moves_spots_to_higher_columns_and_rows(make, waves):
    optics = make(N_SUB, N_PIX, WAVELENGTH, 15.55, 2.3, (12.3, 14.7), (170, 175), gaussian_pupil())

    def centre(frame):
        rows, columns = np.indices(frame.shape)
        # The square makes the wings of the spots, cut by the field, weigh little.
        weight = frame.astype(float) ** 2
        return np.array([(weight * columns).sum(), (weight * rows).sum()]) / weight.sum()

    moved = centre(optics.frame(tilt(*waves))) - centre(optics.frame(PATHS["flat"]))
    assert moved == pytest.approx(2.3 * np.array(waves), abs=0.05)


def test_the_light_of_the_pupil_arrives(bench_geometry):
    power = float(np.square(gaussian_pupil(), dtype=float).sum())
    for optics in bench_geometry:
        assert float(optics.frame(PATHS["flat"]).sum()) == pytest.approx(power, rel=5e-3)


def test_frames_do_not_accumulate_in_oopao(bench_geometry):
    # OOPAO's '*' adds to the last propagation; the twin must start afresh each time.
    _, slow = bench_geometry
    first = slow.frame(PATHS["weak"])
    slow.frame(PATHS["strong"])
    assert np.array_equal(slow.frame(PATHS["weak"]), first)


def test_the_reading_between_samples_is_exact():
    rng = np.random.default_rng(0)
    field = rng.standard_normal(8) + 1j * rng.standard_normal(8)
    samples = np.arange(8)
    at = rng.uniform(-20, 20, 50)

    def image(position):
        return np.abs(np.exp(-2j * np.pi * np.outer(position, samples) / 16) @ field) ** 2

    assert np.allclose(
        trigonometric_interpolation(at, 16) @ image(np.arange(16)), image(at), rtol=0, atol=1e-12
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"amplitude": np.ones((79, 80), np.float32)}, "amplitude has shape"),
        ({"shape": (120, 175)}, "outside the region"),
        ({"shape": (170, 120)}, "outside the region"),
        ({"origin_px": (1.0, 14.7)}, "outside the region"),
        ({"n_pix": 7, "amplitude": np.ones((70, 70), np.float32)}, "even number"),
    ],
)
def test_wrong_geometry_is_refused(change, message):
    args = {
        "n_sub": N_SUB,
        "n_pix": N_PIX,
        "wavelength_m": WAVELENGTH,
        "pitch_px": 15.55,
        "spot_px": 2.3,
        "origin_px": (12.3, 14.7),
        "shape": (170, 175),
        "amplitude": gaussian_pupil(),
    }
    with pytest.raises(ValueError, match=message):
        OOPAOShackHartmann(**{**args, **change})


def test_a_path_of_the_wrong_size_is_refused(bench_geometry):
    with pytest.raises(ValueError, match="optical path has shape"):
        bench_geometry[1].frame(np.zeros((N, N - 1), np.float32))
