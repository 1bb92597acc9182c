"""Phase screens have von Karman statistics, and the plate shows them where it should."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage, special

from escape_sim.atmosphere.phase_plates import RotatingScreen, von_karman_screen

PIXEL, R0, OUTER_SCALE = 0.02, 0.15, 1.5
SIZE = 512


def structure_function(r):
    """Conan (2000), in closed form."""
    x = 2 * np.pi * r / OUTER_SCALE
    c = (24 / 5 * special.gamma(6 / 5)) ** (5 / 6) * special.gamma(11 / 6) * 2 ** (1 / 6) / np.pi ** (8 / 3)
    inner = special.gamma(5 / 6) / 2 ** (1 / 6) - x ** (5 / 6) * special.kv(5 / 6, x)
    return c * (OUTER_SCALE / R0) ** (5 / 3) * inner


@pytest.fixture(scope="module")
def screens():
    rngs = (np.random.default_rng(seed) for seed in range(24))
    return [von_karman_screen(SIZE, PIXEL, R0, OUTER_SCALE, rng).astype(float) for rng in rngs]


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("pixels", [6, 12, 25, 50, 100])
def test_structure_function(screens, axis, pixels):
    found = [np.mean((np.roll(s, -pixels, axis) - s) ** 2) for s in screens]
    scatter = np.std(found, ddof=1) / np.sqrt(len(found))
    want = structure_function(pixels * PIXEL)
    # Statistics, and the frequencies beyond the pixels' and below the screen's.
    assert abs(np.mean(found) - want) < 4 * scatter + 0.04 * want
    assert scatter < 0.05 * want


def test_variance(screens):
    # 0.0863 (L0 / r0)^(5/3)
    found = np.mean([s.var() for s in screens])
    assert found == pytest.approx(0.0863 * (OUTER_SCALE / R0) ** (5 / 3), rel=0.06)
    assert all(abs(s.mean()) < 1e-4 for s in screens)


def test_strength_scales_with_r0():
    weak, strong = (von_karman_screen(64, PIXEL, r0, 0.4, np.random.default_rng(5)) for r0 in (0.3, 0.1))
    assert strong == pytest.approx(weak * 3 ** (5 / 6), rel=1e-4, abs=1e-5)


def test_screens_are_seeded():
    first, again, other = (von_karman_screen(64, PIXEL, R0, 0.4, np.random.default_rng(s)) for s in (7, 7, 8))
    assert np.array_equal(first, again)
    assert abs(np.corrcoef(first.ravel(), other.ravel())[0, 1]) < 0.5
    assert first.dtype == np.float32


RADIUS = 3.1
N = 48


def disk():
    line = np.arange(N) - (N - 1) / 2
    return np.hypot(line[:, None], line) <= N / 2


def plate(lit=None):
    opd = von_karman_screen(256, PIXEL, R0, 0.5, np.random.default_rng(9))
    return RotatingScreen(opd, PIXEL, RADIUS, disk() if lit is None else lit), opd


def read(screen, path):
    out = np.zeros((N, N), np.float32)
    screen.add(path, out)
    return out


@pytest.mark.parametrize("path", [0.0, 0.013, 1.0, 7.77, -2.5, 40.0])
def test_readings_equal_direct_interpolation(path):
    screen, opd = plate()
    line = (np.arange(N) - (N - 1) / 2) * PIXEL
    x, y = np.meshgrid(line + RADIUS, line)
    angle = path / RADIUS
    turned = (np.cos(angle) * x - np.sin(angle) * y, np.sin(angle) * x + np.cos(angle) * y)
    at = [128 + turned[1] / PIXEL, 128 + turned[0] / PIXEL]
    want = ndimage.map_coordinates(opd, at, order=1, mode="grid-wrap")
    lit = disk()
    assert np.abs(read(screen, path) - want)[lit].max() < 2e-3 * opd.std()


def test_one_revolution_repeats():
    screen, opd = plate()
    turn = 2 * np.pi * RADIUS
    assert np.abs(read(screen, 0.4 + turn) - read(screen, 0.4)).max() < 2e-3 * opd.std()


def test_the_pattern_crosses_the_pupil_at_the_asked_speed():
    # A move of k pixels shifts the pattern by k rows at the pupil's middle, towards lower rows.
    screen, _ = plate()
    before, after = read(screen, 0.0), read(screen, 3 * PIXEL)
    inner = slice(14, -14)
    match = {k: np.std(after[inner, inner] - np.roll(before, k, axis=0)[inner, inner]) for k in range(-6, 7)}
    assert min(match, key=lambda k: match[k]) == -3


def test_it_adds_and_leaves_dark_pixels_alone():
    screen, _ = plate()
    out = np.full((N, N), 5.0, np.float32)
    screen.add(0.3, out)
    assert out == pytest.approx(read(screen, 0.3) + 5, abs=1e-5)
    assert (out[~disk()] == 5).all()
    # Rows without any lit pixel are left alone too.
    lit = disk()
    lit[:20] = False
    assert not read(plate(lit)[0], 0.3)[:20].any()


@pytest.mark.parametrize("shape", [(100, 100), (64, 128)])
def test_a_plate_of_unsuitable_size_is_refused(shape):
    with pytest.raises(ValueError, match="power-of-two"):
        RotatingScreen(np.zeros(shape, np.float32), PIXEL, RADIUS, disk())
