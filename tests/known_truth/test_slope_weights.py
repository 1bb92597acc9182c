"""The fast model's matrix is the derivative of the simulated optics and centre of gravity."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import ndtri

from escape_hw.api.registration import Registration
from escape_hw.config.loader import load_system
from escape_hw.pipeline.slopes.shack_hartmann import subaperture_windows
from escape_sim.mirror.nominal import nominal_influence_functions
from escape_sim.models.shack_hartmann import (
    NEIGHBOURS,
    ShackHartmannModel,
    gaussian_lattice,
    lenslet_turbulence,
    nominal_grid,
    slope_weights,
)
from escape_sim.optics.pupil import pupil_geometry
from escape_sim.optics.shack_hartmann import ShackHartmannOptics

MOVED = Registration(35.0, -22.0, 1.3, 1.5, -2.0)
#: Commands of the finite differences: spots move by a few hundredths of a pixel.
STEP = 2e-3


@pytest.fixture(scope="module")
def config():
    return load_system("razor-shwfs")


class Truth:
    """Frames by the twin's optics and slopes by a centre of gravity written out in NumPy."""

    def __init__(self, config, grid, cut=0.0):
        self.config, self.grid, self.cut = config, grid, cut
        self.pupil = pupil_geometry(config)
        width, height = config.devices.wfs.region[2:]
        self.shape = (height, width)
        self.optics = ShackHartmannOptics(
            self.pupil.n_sub, self.pupil.n_pix, config.system.wavelength_m, grid.pitch_px,
            config.sensor.spot_px, grid.origin_px, self.shape, self.pupil.amplitude,
        )  # fmt: skip
        self.boxes = subaperture_windows(grid.centres_px(), grid.pitch_px, self.shape)

    def image(self, opd):
        return self.optics.frame(opd.astype(np.float32)).astype(float)

    def slopes(self, opd):
        return self.slopes_of(self.image(opd))

    def slopes_of(self, image):
        light = np.maximum(image - self.cut, 0.0)
        out = np.empty((2, self.grid.n_valid))
        for k, (top, end, left, right) in enumerate(self.boxes):
            part = light[top:end, left:right]
            total = part.sum()
            out[:, k] = (
                part.sum(0) @ np.arange(left, right) / total,
                part.sum(1) @ np.arange(top, end) / total,
            )
        return out.ravel()

    @property
    def px_per_metre(self):
        return self.config.system.wavelength_m / self.pupil.sub_aperture_m / self.config.sensor.spot_px

    def tilt(self, x_px, y_px):
        """Path that moves all spots by so many pixels."""
        x = self.pupil.coordinates_m * self.px_per_metre
        return x_px * x[None, :] + y_px * x[:, None]

    def tilts(self, moves_px):
        """Path that moves the spot of each sub-aperture by its own number of pixels along x and y."""
        n, p = self.pupil.n_sub, self.pupil.n_pix
        x = self.pupil.coordinates_m.reshape(n, p) * self.px_per_metre
        x = (x - x.mean(axis=1, keepdims=True)).ravel()
        along_x, along_y = np.kron(moves_px.reshape(2, n, n), np.ones((p, p)))
        return along_x * x + along_y * x[:, None]

    def column(self, surface, around=0.0):
        # Reflection doubles the surface.
        opd = STEP * 2 * self.config.devices.dm.stroke_m * surface
        return (self.slopes(around + opd) - self.slopes(around - opd)) / (2 * STEP)


def surfaces(config, registration, width=1.0):
    pupil = pupil_geometry(config)
    influence = replace(nominal_influence_functions(config), width=width)
    x = pupil.coordinates_m
    return influence.surfaces(registration, pupil.sub_aperture_m, x, x)


def worst(matrix, truth):
    """Largest error relative to the largest response of the same actuators."""
    return np.abs(matrix - truth).max() / np.abs(truth).max()


@pytest.mark.parametrize(("registration", "width"), [(Registration(), 1.0), (MOVED, 1.1)])
def test_the_matrix_equals_finite_differences(config, registration, width):
    grid = nominal_grid(config)
    truth = Truth(config, grid)
    some = np.arange(0, 97, 4)
    shapes = surfaces(config, registration, width)
    want = np.stack([truth.column(shapes[a]) for a in some], axis=1)
    matrix = ShackHartmannModel(config, grid).zonal_matrix(registration, width)
    assert matrix.shape == (grid.n_slopes, 97)
    assert worst(matrix[:, some], want) < 1e-3


def test_a_grid_off_the_pixels_changes_the_matrix_as_the_optics_do(config):
    centred = nominal_grid(config)
    grid = replace(
        centred, pitch_px=15.61, origin_px=(centred.origin_px[0] + 0.41, centred.origin_px[1] - 1.3)
    )
    truth, some = Truth(config, grid), np.arange(2, 97, 12)
    shapes = surfaces(config, MOVED)
    want = np.stack([truth.column(shapes[a]) for a in some], axis=1)
    assert worst(ShackHartmannModel(config, grid).zonal_matrix(MOVED)[:, some], want) < 1e-3
    # The grid matters by more than that.
    assert worst(ShackHartmannModel(config, centred).zonal_matrix(MOVED)[:, some], want) > 5e-3


def with_counts(config):
    """A grid that knows how bright it is, and the threshold in the units of the optics."""
    grid = replace(nominal_grid(config), counts=3600.0)
    pupil = pupil_geometry(config)
    n, p = pupil.n_sub, pupil.n_pix
    light = np.square(pupil.amplitude, dtype=float).reshape(n, p, n, p).sum(axis=(1, 3))
    bright = np.percentile(light[light > 0], 95)
    return grid, config.sensor.threshold * 1023 / 3600.0 * bright


def test_a_threshold_is_respected(config):
    grid, cut = with_counts(config)
    truth, some = Truth(config, grid, cut), np.arange(1, 97, 8)
    shapes = surfaces(config, MOVED)
    want = np.stack([truth.column(shapes[a]) for a in some], axis=1)
    found = ShackHartmannModel(config, grid).zonal_matrix(MOVED)[:, some]
    # Median over slopes: where a pixel crosses the threshold within the step, the difference has a kink.
    error = np.linalg.norm(found - want, axis=1) / np.linalg.norm(want, axis=1)
    assert np.median(error) < 2e-3
    assert np.linalg.norm(found - want) < 0.015 * np.linalg.norm(want)
    plain = ShackHartmannModel(config, nominal_grid(config)).zonal_matrix(MOVED)[:, some]
    assert np.linalg.norm(plain - want) > 0.1 * np.linalg.norm(want)


def lattice(n: int, step: int) -> np.ndarray:
    """Places of equal weight spread over a round Gaussian, other ones than the model's."""
    i = np.arange(n)
    return ndtri((np.stack([i, (i * step) % n], axis=1) + 0.5) / n)


@pytest.mark.parametrize("motion_px", [0.5, 1.1])
@pytest.mark.slow
def test_motion_averages_over_where_the_spots_are(config, motion_px):
    grid, cut = with_counts(config)
    grid = replace(grid, motion_px=motion_px)
    truth, shape = Truth(config, grid, cut), surfaces(config, MOVED)[48]
    # Spots are everywhere equally often, and neighbours at places that have nothing to do with each other.
    rng, n_spots = np.random.default_rng(1), truth.pupil.n_sub**2
    places = motion_px * np.stack([rng.permutation(lattice(89, 55)) for _ in range(n_spots)], axis=2)
    want = np.mean([truth.column(shape, truth.tilts(at)) for at in places], axis=0)
    found = ShackHartmannModel(config, grid).zonal_matrix(MOVED)[:, 48]
    size = np.linalg.norm(want)
    assert np.linalg.norm(found - want) < 0.012 * size
    still = ShackHartmannModel(config, replace(grid, motion_px=0.0)).zonal_matrix(MOVED)[:, 48]
    assert np.linalg.norm(still - want) > 0.08 * size


@pytest.mark.slow
def test_noise_makes_the_threshold_gradual(config):
    grid, cut = with_counts(config)
    counts_per_light = config.sensor.threshold * 1023 / cut
    truth, shape = Truth(config, grid, cut), surfaces(config, MOVED)[48]
    opd, rng = STEP * 2 * config.devices.dm.stroke_m * shape, np.random.default_rng(0)
    up, down = truth.image(opd), truth.image(-opd)
    noise = 2.0 / counts_per_light * rng.standard_normal((400, *up.shape))
    # The same noise in both: it drops out of the difference but for its effect on the threshold.
    want = np.mean([truth.slopes_of(up + n) - truth.slopes_of(down + n) for n in noise], axis=0) / (2 * STEP)
    found = ShackHartmannModel(config, replace(grid, pixel_noise=2.0)).zonal_matrix(MOVED)[:, 48]
    size = np.linalg.norm(want)
    assert np.linalg.norm(found - want) < 0.02 * size
    sharp = ShackHartmannModel(config, grid).zonal_matrix(MOVED)[:, 48]
    assert np.linalg.norm(sharp - want) > 2 * np.linalg.norm(found - want)


@pytest.mark.slow
def test_the_average_keeps_no_pattern_of_the_pixels(config):
    """A lattice of spots that is moved by half a pixel answers alike once the spots move by a pixel."""
    grid, _ = with_counts(config)
    grid = replace(grid, motion_px=1.1)
    shifted = replace(grid, origin_px=tuple(np.add(grid.origin_px, 0.5)))
    here, there = (ShackHartmannModel(config, g).zonal_matrix(MOVED) for g in (grid, shifted))
    # What is left is the windows, which are of whole pixels.
    assert np.linalg.norm(here - there) < 0.02 * np.linalg.norm(here)


def test_weights_sum_to_the_response_to_tilts_and_ignore_piston(config):
    grid, pupil = nominal_grid(config), pupil_geometry(config)
    weights = slope_weights(config, grid, pupil)
    assert set(weights) == set(NEIGHBOURS)
    truth = Truth(config, grid)
    rows, columns = np.nonzero(grid.valid)
    for x_px, y_px in ((1.0, 0.0), (0.3, -0.8)):
        opd = truth.tilt(x_px, y_px)
        blocks = opd.reshape(24, 8, 24, 8).transpose(0, 2, 1, 3)
        found = np.zeros((2, grid.n_valid))
        for (down, right), block in weights.items():
            i, j = np.clip(rows + down, 0, 23), np.clip(columns + right, 0, 23)
            found += np.einsum("akqp,kqp->ak", block, blocks[i, j])
        want = (truth.slopes(0.01 * opd) - truth.slopes(-0.01 * opd)) / 0.02
        assert worst(found.ravel(), want) < 1e-3
        # Windows cut the spots' wings off: a centre of gravity shows less than the spot moves.
        assert 0.7 < np.median(found[0]) / x_px < 1
    largest = np.abs(weights[0, 0]).sum(axis=(2, 3)).max()
    for block in weights.values():
        # Each lenslet's own piston moves nothing, for the lenslets' light does not interfere.
        assert np.abs(block.sum(axis=(2, 3))).max() < 1e-6 * largest


def test_a_grid_of_another_size_is_refused(config):
    grid = nominal_grid(config)
    with pytest.raises(ValueError, match="23"):
        ShackHartmannModel(config, replace(grid, valid=grid.valid[:23, :23]))


def test_turbulence_within_a_lenslet_has_no_side_and_kolmogorovs_variance():
    phases = lenslet_turbulence(8)
    places = gaussian_lattice()
    np.testing.assert_allclose(phases[::-1, ::-1, ::-1], phases, atol=1e-12)
    u = np.linspace(-1, 1, 8)
    flat = phases.reshape(len(phases), -1)
    for shape in (np.ones((8, 8)), np.broadcast_to(u, (8, 8)), np.broadcast_to(u[:, None], (8, 8))):
        np.testing.assert_allclose(flat @ shape.ravel(), 0, atol=1e-10)
    # Noll (1976): 0.134 rad^2 are left without piston and tilt on a round aperture; a square one has corners.
    assert 0.12 < np.square(phases).mean() < 0.16
    # Where a spot stands says nothing about the wavefront within its lenslet.
    half = len(places) // 2
    np.testing.assert_allclose(places[:half].T @ flat[:half], 0, atol=1e-9)


def test_a_blurred_spot_follows_a_tilt_as_a_sharp_one_does():
    """Turbulence within the lenslets changes what happens there, not how spots move as a whole."""
    config = load_system("razor-shwfs", overrides=["sensor.n_sub=12", "devices.wfs.region=[220,156,200,200]"])
    grid = replace(nominal_grid(config), counts=2500.0, motion_px=0.9)
    pupil = pupil_geometry(config)
    still, blurred = (
        slope_weights(config, replace(grid, turbulence_px=turbulence), pupil) for turbulence in (0.0, 0.7)
    )
    near = np.abs(blurred[0, 0] - still[0, 0]).max() / np.abs(still[0, 0]).max()
    # It changes the answer, and not by much.
    assert 0.01 < near < 1
    # A tilt of the whole wavefront moves every spot as it does without turbulence, or nearly.
    x = np.tile(pupil.coordinates_m, (pupil.coordinates_m.size, 1))
    tilt = x.reshape(pupil.n_sub, pupil.n_pix, pupil.n_sub, pupil.n_pix).transpose(0, 2, 1, 3)
    inner = np.zeros_like(grid.valid)
    inner[4:8, 4:8] = True
    rows, columns = np.nonzero(grid.valid)

    def response(weights):
        total = np.zeros(rows.size)
        for (down, right), block in weights.items():
            i, j = np.clip(rows + down, 0, 11), np.clip(columns + right, 0, 11)
            total += np.einsum("spq,spq->s", block[0], tilt[i, j])
        return total[inner[grid.valid]]

    np.testing.assert_allclose(response(blurred), response(still), rtol=0.15)


def test_weights_around_given_wavefronts_are_the_mean_of_the_simulated_responses(config):
    grid = nominal_grid(config)
    truth, pupil = Truth(config, grid), pupil_geometry(config)
    at = pupil.coordinates_m / (config.system.pupil_m / 2)
    # Curved within a lenslet, which no tilt of whole lenslets is.
    paths = [
        60e-9 * np.outer(np.sin(50 * at), np.cos(40 * at)) + truth.tilt(0.3, -0.2) * sign for sign in (1, -1)
    ]
    surface = surfaces(config, MOVED)[48]
    exact = np.mean([truth.column(surface, around=path) for path in paths], axis=0)

    def error(model):
        column = model.zonal_matrix(MOVED)[:, 48]
        return np.linalg.norm(column - exact) / np.linalg.norm(exact)

    assert error(ShackHartmannModel(config, grid, paths)) < 1e-3
    # The small-signal response is another one.
    assert error(ShackHartmannModel(config, grid)) > 0.03
