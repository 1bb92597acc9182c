"""A contaminated and unevenly lit pupil: its centre from the shadow, with the error that it has."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from escape_hw.config.system import TelescopeSection
from escape_hw.pipeline.geometry.obscuration import build_shadow, transmitted_fraction
from escape_hw.pipeline.geometry.pupil_images import find_pupil_images, refine_pupil_images
from escape_hw.pipeline.geometry.pupil_rims import estimate_roundness_error
from escape_hw.pipeline.geometry.shadow_fit import fit_shadow_offset

N, SHAPE = 30, (80, 80)
NOMINAL = np.array([[19.5, 19.5], [59.5, 19.5], [19.5, 59.5], [59.5, 59.5]])
DIAMETER_M = 6.5
TELESCOPE = TelescopeSection(obscuration=0.11, spider_m=0.05, spiders_deg=(45.0, 135.0, 225.0, 315.0))
FINE = 8


def eaten(rng: np.random.Generator, depth: float) -> NDArray[np.float64]:
    """Radius ``(360,)`` of a pupil by angle, in diameters: a circle, eaten into by so much (rms)."""
    angle = np.deg2rad(np.arange(360))
    waves = sum(np.cos(k * angle + rng.uniform(0, 2 * np.pi)) for k in range(1, 6)) / np.sqrt(2.5)
    return 0.5 * (1 - depth * np.abs(waves))


def uneven(rng: np.random.Generator, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """Waves of unit mean square, none shorter than a quarter of the diameter."""
    waves = [
        np.cos(2 * np.pi * (kx * x[None, :] + ky * y[:, None]) + rng.uniform(0, 2 * np.pi))
        for kx, ky in rng.uniform(-3, 3, (12, 2))
    ]
    return np.asarray(np.sum(waves, axis=0) / np.sqrt(6))


def frame(
    centres: NDArray[np.float64],
    rng: np.random.Generator,
    depth: float,
    noise: float = 0.01,
    unevenness: float = 0.0,
    telescope: TelescopeSection = TELESCOPE,
) -> NDArray[np.float32]:
    """Four images of one eaten pupil with a shadow in it."""
    rim, image, seed = eaten(rng, depth), np.zeros(SHAPE), int(rng.integers(2**31))
    for cx, cy in centres:
        # Only the pixels that this image may reach.
        columns, rows = (slice(int(c - N / 2) - 1, int(c + N / 2) + 3) for c in (cx, cy))
        x, y = (np.arange(80)[columns] - cx) / N, (np.arange(80)[rows] - cy) / N
        inner = (np.arange(FINE) + 0.5) / FINE - 0.5
        fx, fy = ((at[:, None] + inner / N).ravel() for at in (x, y))
        degree = (np.rad2deg(np.arctan2(fy[:, None], fx)) % 360).astype(int)
        inside = np.hypot(fx, fy[:, None]) <= rim[degree]
        inside = inside.reshape(y.size, FINE, x.size, FINE).mean(axis=(1, 3))
        smooth = 1 + unevenness * uneven(np.random.default_rng(seed), x, y)
        slope = smooth + rng.uniform(-0.2, 0.2) * x[None, :] + rng.uniform(-0.2, 0.2) * y[:, None]
        # With few points the width of a vane at 45 degrees depends on where it lies.
        seen = transmitted_fraction(telescope, DIAMETER_M, x * DIAMETER_M, y * DIAMETER_M, points=40)
        image[rows, columns] += 400 * inside * slope * seen
    # What diffraction adds to the pixels' own width.
    image = ndimage.gaussian_filter(image, 0.4)
    return (image + 400 * noise * rng.standard_normal(SHAPE)).astype(np.float32)


def test_the_shadow_is_found_where_it_is() -> None:
    errors = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        place = rng.uniform(-0.3, 0.3, 2)
        image = frame(NOMINAL + place, rng, 0.0).astype(float)
        shadow = build_shadow(TELESCOPE, DIAMETER_M)
        assert shadow is not None
        offset, sigma = fit_shadow_offset(image, NOMINAL, N, shadow)
        errors.append(offset - place)
        assert 0 < sigma < 0.04
    assert np.sqrt(np.mean(np.square(errors))) < 0.03


def test_without_an_obscuration_there_is_no_shadow() -> None:
    assert build_shadow(TelescopeSection(), DIAMETER_M) is None


@pytest.mark.slow
@pytest.mark.parametrize(
    ("depth", "unevenness", "bound"), [(0.0, 0.0, 0.01), (0.02, 0.06, 0.02)], ids=["clean", "contaminated"]
)
def test_the_mean_position_has_the_stated_error(depth: float, unevenness: float, bound: float) -> None:
    errors, stated = [], []
    telescope = TELESCOPE.model_copy(update={"obscuration": 0.25})
    for seed in range(6):
        rng = np.random.default_rng(seed)
        centres = NOMINAL + rng.uniform(-0.4, 0.4, (4, 2))
        image = frame(centres, rng, depth, unevenness=unevenness, telescope=telescope)
        first = find_pupil_images(image, n_sub=N, nominal_px=NOMINAL, min_flux=0.4)
        found = refine_pupil_images([image], first, build_shadow(telescope, DIAMETER_M))
        errors.append((found.centres_px - centres).mean(axis=0))
        stated.append(found.centre_sigma_px)
    assert np.sqrt(np.mean(np.square(errors))) < bound
    # Twelve values: their mean square is known to 40 %.
    assert 0.3 < np.mean(np.square(np.array(errors) / np.array(stated)[:, None])) < 2.5


@pytest.mark.slow
def test_a_contaminated_rim_shifts_its_circle_but_not_the_images() -> None:
    rim, shadow, stated = [], [], []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        centres = NOMINAL + rng.uniform(-0.4, 0.4, (4, 2))
        image = frame(centres, rng, 0.02)
        first = find_pupil_images(image, n_sub=N, nominal_px=NOMINAL, min_flux=0.4)
        found = refine_pupil_images([image], first, build_shadow(TELESCOPE, DIAMETER_M))
        plain = refine_pupil_images([image], first)
        rim.append((plain.centres_px - centres).mean(axis=0))
        shadow.append((found.centres_px - centres).mean(axis=0))
        stated.append((plain.centre_sigma_px, found.centre_sigma_px))
    by_rim, by_shadow = np.sqrt(np.mean(np.square(rim))), np.sqrt(np.mean(np.square(shadow)))
    assert by_rim > 0.02
    assert by_shadow < 0.7 * by_rim
    sigma = np.sqrt(np.mean(np.square(stated), axis=0))
    assert sigma[0] == pytest.approx(by_rim, rel=0.6)
    assert 0 < sigma[1] < 3 * by_shadow


@pytest.mark.slow
def test_large_images_are_binned() -> None:
    rng = np.random.default_rng(5)
    place = np.array([0.3, -0.2])
    image = np.repeat(np.repeat(frame(NOMINAL + place, rng, 0.0).astype(float), 2, axis=0), 2, axis=1)
    shadow = build_shadow(TELESCOPE, DIAMETER_M)
    assert shadow is not None
    small, sigma = fit_shadow_offset(image[::2, ::2], NOMINAL, N, shadow)
    large, sigma_large = fit_shadow_offset(image, 2 * NOMINAL + 0.5, 2 * N, shadow)
    assert large == pytest.approx(2 * small, abs=sigma)
    assert sigma_large == pytest.approx(2 * sigma, rel=0.3)


def test_a_clean_rim_is_round() -> None:
    rng = np.random.default_rng(3)
    whole = frame(NOMINAL, rng, 0.0, noise=0.002).astype(float)
    contaminated = frame(NOMINAL, np.random.default_rng(3), 0.03, noise=0.002).astype(float)
    assert estimate_roundness_error(whole, NOMINAL, N / 2, N / 2) < 0.02
    assert estimate_roundness_error(contaminated, NOMINAL, N / 2, N / 2) > 0.04
