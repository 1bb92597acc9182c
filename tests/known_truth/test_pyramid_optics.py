"""The twin's pyramid optics are OOPAO's, and a plain Fourier transform's."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from sensor_frames import turbulence
from small_pyramid import configuration

from escape_sim.oopao.library import make_pyramid, make_source, oopao_classes, suppress_output
from escape_sim.oopao.optics import OOPAOPyramid
from escape_sim.optics.base import ModulatedOptics
from escape_sim.optics.fourier_filter import next_fast_length
from escape_sim.optics.modulation import ModulationPath
from escape_sim.optics.pupil import pupil_geometry
from escape_sim.optics.pyramid import Prism, PyramidOptics
from escape_sim.optics.sensor import make_sensor_optics

WAVELENGTH = 635e-9
#: Single precision of the fast optics, relative to the brightest pixel.
TOLERANCE = 1e-6
#: The bench's images: upper left, upper right, lower left, lower right.
BENCH = np.array([[45.0, 48.0], [152.0, 65.0], [46.0, 128.0], [130.0, 128.0]])
CORNERS = np.array([[-1, -1], [1, -1], [-1, 1], [1, 1]])


def beam(n: int) -> NDArray[np.float32]:
    y, x = np.indices((n, n)) - (n - 1) / 2
    r2 = x**2 + y**2
    amplitude = np.where(r2 <= (n / 2) ** 2, np.exp(-r2 / (0.75 * n) ** 2), 0)
    return (amplitude / np.sqrt((amplitude**2).sum())).astype(np.float32)


def tilt(n: int, x_waves: float, y_waves: float) -> NDArray[np.float32]:
    """Path that moves the image by so many lambda/D."""
    y, x = (np.indices((n, n)) - (n - 1) / 2) / n * WAVELENGTH
    return (x_waves * x + y_waves * y).astype(np.float32)


PATHS = {rms: rms * 1e-9 for rms in (0, 50, 700)}


def square(n_px: int, separation: int, grid: int) -> NDArray[np.float64]:
    return (grid - 1) / 2 + CORNERS * (n_px + separation) / 2


def make(n_px, centres, grid, radius, samples=1, products=None) -> PyramidOptics:
    """Optics that propagate by matrix products or by transforms; by default by the faster of the two."""
    args = (beam(n_px * samples), n_px, WAVELENGTH, centres, (grid, grid), ModulationPath.circle(radius))
    with pytest.MonkeyPatch.context() as patch:
        if products is not None:
            patch.setattr("escape_sim.optics.pyramid._matrix_product_is_faster", lambda *_: products)
        optics = PyramidOptics(*args, samples=samples, grid_px=grid)
    assert products is None or optics.uses_matrix_products == products
    return optics


# ------------------------------------------------------------------ OOPAO by itself
@pytest.mark.parametrize(
    ("samples", "n_px", "separation", "radius"),
    [(1, 64, 2, 3.0), (1, 64, 2, 0.0), (2, 32, 4, 5.0), (2, 20, 6, 3.0), (4, 10, 8, 3.0)],
)
def test_frames_equal_those_of_oopao(samples, n_px, separation, radius):
    # OOPAO with nothing but its own arguments: its circle of points, its square of images.
    n = n_px * samples
    light = make_source(beam(n), 1.0, WAVELENGTH)
    with suppress_output():
        sensor = make_pyramid(light, n_px, separation, separation // 2)
        sensor.modulation = radius
    grid = 2 * n_px + separation + 2 * (separation // 2)
    ours = {
        # One lambda/D of OOPAO's is one wave between the centres of the outermost samples.
        products: make(n_px, square(n_px, separation, grid), grid, radius * n / (n - 1), samples, products)
        for products in (True, False)
    }
    assert len(ours[True].modulation.points) == max(1, 4 * int(np.ceil(np.pi * radius / 2)))
    for rms in PATHS.values():
        opd = turbulence(n, rms)
        with suppress_output():
            light.source**light.telescope * oopao_classes().OPD_map(opd.astype(float)) * sensor
        theirs = np.asarray(sensor.cam.frame) / light.photons_per_unit
        assert theirs.sum() == pytest.approx(1, rel=1e-6)
        for optics in ours.values():
            assert np.abs(optics.frame(opd) - theirs).max() < TOLERANCE * theirs.max()


# ------------------------------------------------------------------ OOPAO inside the twin
ELLIPSE = ModulationPath(
    ModulationPath.circle(3.0, ellipse=0.1, ellipse_angle=0.4).points + np.array([0.2, -0.1])
)
UNEVEN = ModulationPath(np.array([[1.0, 0.5], [-2.0, 0.1], [0.0, 3.0]]))
ANGLE = 0.1
TURNED = 71.5 + 34 * CORNERS @ np.array([[np.cos(ANGLE), np.sin(ANGLE)], [-np.sin(ANGLE), np.cos(ANGLE)]])


@pytest.mark.parametrize(
    ("n_px", "centres", "shape", "more"),
    [
        (64, BENCH, (192, 192), {}),
        (64, BENCH, (150, 192), {"rooftop": 1.5}),
        (64, square(64, 8, 144) + np.array([3.3, -2.2]), (144, 144), {"rooftop": -2.0}),
        (64, TURNED, (144, 144), {}),
        (16, square(16, 4, 40) + np.array([[0.3, 0], [0, 0.4], [-0.2, 0], [0, 0]]), (40, 44), {"samples": 2}),
    ],
)
def test_the_twin_sees_the_same_frames_with_oopao_inside(n_px, centres, shape, more):
    n = n_px * more.get("samples", 1)
    modulation = ModulationPath.circle(3.0)
    args = (beam(n), n_px, WAVELENGTH, centres, shape, modulation)
    fast, slow = PyramidOptics(*args, **more), OOPAOPyramid(*args, **more)
    for change in (modulation, ELLIPSE, UNEVEN):
        fast.modulation = slow.modulation = change
        for rms in PATHS.values():
            opd = turbulence(n, rms)
            ours, theirs = fast.frame(opd), slow.frame(opd)
            assert ours.shape == theirs.shape == shape
            assert np.abs(ours - theirs).max() < TOLERANCE * theirs.max()


def test_one_key_puts_oopao_into_the_bench():
    optics = []
    for key in ("fast", "oopao"):
        config = configuration(f"system.optics={key}", "twin.pyramid.rooftop=0.5")
        optics.append(make_sensor_optics(config, pupil_geometry(config)))
        assert isinstance(optics[-1], ModulatedOptics)
        optics[-1].modulation = ELLIPSE
    fast, slow = (o.frame(turbulence(16, 300e-9)) for o in optics)
    assert type(optics[0]) is not type(optics[1])
    assert np.abs(fast - slow).max() < TOLERANCE * slow.max()


def test_frames_do_not_accumulate_in_oopao():
    slow = OOPAOPyramid(beam(16), 16, WAVELENGTH, square(16, 4, 40), (40, 40), ModulationPath.circle(1.0))
    first = slow.frame(turbulence(16, 50e-9))
    slow.frame(turbulence(16, 700e-9))
    assert np.array_equal(slow.frame(turbulence(16, 50e-9)), first)


# ------------------------------------------------------------------ a second route
def plain(field, centres, grid, points, diameter):
    """Zero padding, transform, faces chosen one by one, transform back; all in double precision."""
    n = len(field)
    k = (np.arange(grid) - (grid - 1) / 2) / grid
    corner = (grid - n) // 2
    slopes = centres - corner - (n - 1) / 2
    height = np.array([gx * k + gy * k[:, None] for gx, gy in slopes])
    mask = np.choose(height.argmax(axis=0), np.exp(-2j * np.pi * height))
    to_between = np.exp(-2j * np.pi * k[0] * np.arange(grid))
    position = np.arange(n) - (n - 1) / 2
    power = np.zeros((grid, grid))
    for x, y in points:
        wide = np.zeros((grid, grid), complex)
        wide[corner : corner + n, corner : corner + n] = field * np.exp(
            2j * np.pi * (x * position + y * position[:, None]) / diameter
        )
        power += np.abs(np.fft.ifft2(np.fft.fft2(wide * to_between * to_between[:, None]) * mask)) ** 2
    return power / len(points)


@pytest.mark.parametrize("radius", [0.0, 3.0, 5.0])
@pytest.mark.parametrize("rms", PATHS)
@pytest.mark.parametrize(
    ("n", "centres", "grid", "products"),
    [
        (64, BENCH, 192, None),
        (48, square(48, 6, 108), 108, True),
        (48, square(48, 6, 108), 108, False),
        (48, square(48, 7, 108) + np.array([0.31, -0.17]), 108, None),
    ],
)
def test_frames_equal_a_plain_fourier_transform(n, centres, grid, products, rms, radius):
    optics = make(n, centres, grid, radius, products=products)
    opd = turbulence(n, PATHS[rms])
    field = beam(n) * np.exp(2j * np.pi * opd.astype(float) / WAVELENGTH)
    want = plain(field, centres, grid, optics.modulation.points, n)
    assert np.abs(optics.frame(opd) - want).max() < TOLERANCE * want.max()


# ------------------------------------------------------------------ what the frames must look like
def quarters(frame):
    """Light in the upper-left, upper-right, lower-left and lower-right quarters."""
    h, w = frame.shape[0] // 2, frame.shape[1] // 2
    return np.array([frame[:h, :w].sum(), frame[:h, w:].sum(), frame[h:, :w].sum(), frame[h:, w:].sum()])


@pytest.mark.parametrize("build", [PyramidOptics, OOPAOPyramid])
def test_a_positive_slope_sends_the_light_to_higher_columns_and_rows(build):
    optics = build(beam(32), 32, WAVELENGTH, square(32, 8, 80), (80, 80), ModulationPath.circle(0.0))
    for waves, share in (((4, 0), (0, 1, 0, 1)), ((0, 4), (0, 0, 1, 1)), ((-4, 4), (0, 0, 1, 0))):
        assert quarters(optics.frame(tilt(32, *waves))) == pytest.approx(
            np.array(share) / sum(share), abs=0.06
        )


def test_images_are_at_their_positions_and_upright():
    # Light far out on one face makes one full image of the pupil.
    pupil = beam(64)
    pupil[:32, :20] = 0
    optics = PyramidOptics(pupil, 64, WAVELENGTH, BENCH, (192, 192), ModulationPath.circle(0.0))
    y, x = np.indices((64, 64)) - 31.5
    # The square makes the light that edges scatter weigh little.
    reference = pupil.astype(float) ** 4
    want = np.array([(reference * x).sum(), (reference * y).sum()]) / reference.sum()
    rows, columns = np.indices((192, 192))
    for centre, side in zip(BENCH, CORNERS, strict=True):
        frame = optics.frame(tilt(64, *(12 * side))).astype(float)
        box = (np.abs(columns - centre[0]) < 40) & (np.abs(rows - centre[1]) < 40)
        weight = frame**2 * box
        at = np.array([(weight * columns).sum(), (weight * rows).sum()]) / weight.sum()
        assert at - centre == pytest.approx(want, abs=0.15)


def test_the_light_of_the_pupil_arrives():
    for products in (True, False):
        optics = make(32, square(32, 8, 80), 80, 3.0, products=products)
        assert float(optics.frame(turbulence(32, 300e-9)).sum()) == pytest.approx(1, rel=1e-5)


def test_frames_are_added_to_the_image_given():
    optics = make(32, square(32, 8, 80), 80, 3.0)
    alone = optics.frame(turbulence(32, 300e-9))
    image = np.ones((80, 80), np.float32)
    assert optics.frame(turbulence(32, 300e-9), image) is image
    assert np.allclose(image - 1, alone, rtol=0, atol=2e-7)


def test_light_beside_the_region_is_lost():
    centres = square(32, 8, 80)
    whole = make(32, centres, 80, 3.0, products=False).frame(turbulence(32, 300e-9))
    modulation = ModulationPath.circle(3.0)
    small = PyramidOptics(
        beam(32), 32, WAVELENGTH, centres - np.array([12, 10]), (56, 60), modulation, grid_px=80
    ).frame(turbulence(32, 300e-9))
    assert np.abs(small - whole[10:66, 12:72]).max() < TOLERANCE * whole.max()
    # A region larger than the grid stays dark outside.
    large = PyramidOptics(
        beam(32), 32, WAVELENGTH, centres + np.array([12, 10]), (120, 110), modulation, grid_px=80
    ).frame(turbulence(32, 300e-9))
    assert np.abs(large[10:90, 12:92] - whole).max() < TOLERANCE * whole.max()
    assert large.sum() == pytest.approx(whole.sum(), rel=1e-6)


def test_the_same_path_gives_the_same_frame_to_the_last_bit():
    args = (64, BENCH, 192, 3.0)
    one, two = make(*args), make(*args)
    opd = turbulence(64, 300e-9)
    assert np.array_equal(one.frame(opd), two.frame(opd))
    assert np.array_equal(one.frame(opd), one.frame(opd))


def test_the_modulator_starts_changes_and_stops():
    optics, opd = make(32, square(32, 8, 80), 80, 0.0), turbulence(32, 300e-9)
    for radius in (3.0, 5.0, 0.0):
        optics.modulation = ModulationPath.circle(radius)
        assert np.array_equal(optics.frame(opd), make(32, square(32, 8, 80), 80, radius).frame(opd))


def test_a_rooftop_is_as_long_as_it_says():
    # Where the two raised faces meet on the diagonal, and where they do not.
    n, grid, length = 32, 512, 4.0
    prism = Prism(20.0 * CORNERS, n, length)
    mask = np.angle(prism.mask(grid))
    heights = np.diag(np.fliplr(mask))
    # Along that diagonal the raised faces have the same height everywhere.
    flat = np.abs(heights - heights[grid // 2]) < 1e-9
    assert flat.sum() * np.sqrt(2) * n / grid == pytest.approx(length, abs=np.sqrt(2) * n / grid)


# ------------------------------------------------------------------ what is refused
@pytest.mark.parametrize("build", [PyramidOptics, OOPAOPyramid])
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"amplitude": np.ones((31, 32), np.float32)}, "amplitude has shape"),
        ({"amplitude": np.ones((31, 31), np.float32)}, "amplitude has shape"),
        ({"grid_px": 27}, "grid of 27 pixels"),
        ({"centres_px": square(32, 8, 80)[::-1]}, "order upper left"),
        ({"centres_px": square(32, 8, 80)[:3]}, "must be finite and \\(4, 2\\)"),
    ],
)
def test_wrong_geometry_is_refused(build, change, message):
    args = {
        "amplitude": beam(32),
        "diameter_px": 32,
        "wavelength_m": WAVELENGTH,
        "centres_px": square(32, 8, 80),
        "shape": (80, 80),
        "modulation": ModulationPath.circle(0.0),
    }
    with pytest.raises(ValueError, match=message):
        build(**{**args, **change})


def test_matrix_products_need_a_rectangle():
    assert not make(64, BENCH, 192, 3.0).uses_matrix_products


@pytest.mark.parametrize("build", [PyramidOptics, OOPAOPyramid])
def test_a_path_of_the_wrong_size_is_refused(build):
    optics = build(beam(16), 16, WAVELENGTH, square(16, 4, 40), (40, 40), ModulationPath.circle(0.0))
    with pytest.raises(ValueError, match="optical path has shape"):
        optics.frame(np.zeros((16, 15), np.float32))


def test_grids_have_lengths_that_transform_fast():
    assert [next_fast_length(x) for x in (130, 192, 193, 250)] == [144, 192, 200, 256]
    assert next_fast_length(25, 4) == 25
