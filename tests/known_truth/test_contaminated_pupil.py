"""A pupil with a contaminated rim: its centre from the shadow, and an error that includes the rim."""

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


def frame(
    centres: NDArray[np.float64], rng: np.random.Generator, depth: float, noise: float = 0.01
) -> NDArray[np.float32]:
    """Four images of one eaten pupil with a shadow in it."""
    rim, image = eaten(rng, depth), np.zeros(SHAPE)
    for cx, cy in centres:
        # Only the pixels that this image may reach.
        columns, rows = (slice(int(c - N / 2) - 1, int(c + N / 2) + 3) for c in (cx, cy))
        x, y = (np.arange(80)[columns] - cx) / N, (np.arange(80)[rows] - cy) / N
        inner = (np.arange(FINE) + 0.5) / FINE - 0.5
        fx, fy = ((at[:, None] + inner / N).ravel() for at in (x, y))
        degree = (np.rad2deg(np.arctan2(fy[:, None], fx)) % 360).astype(int)
        inside = np.hypot(fx, fy[:, None]) <= rim[degree]
        inside = inside.reshape(y.size, FINE, x.size, FINE).mean(axis=(1, 3))
        slope = 1 + rng.uniform(-0.2, 0.2) * x[None, :] + rng.uniform(-0.2, 0.2) * y[:, None]
        image[rows, columns] += (
            400 * inside * slope * transmitted_fraction(TELESCOPE, DIAMETER_M, x * DIAMETER_M, y * DIAMETER_M)
        )
    # What diffraction adds to the pixels' own width.
    image = ndimage.gaussian_filter(image, 0.4)
    return (image + 400 * noise * rng.standard_normal(SHAPE)).astype(np.float32)


def test_the_shadow_is_found_where_it_is() -> None:
    errors = []
    for seed in range(6):
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


def test_a_contaminated_rim_shifts_its_circle_and_the_error_includes_it() -> None:
    rim, both, stated = [], [], []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        centres = NOMINAL + rng.uniform(-0.4, 0.4, (4, 2))
        image = frame(centres, rng, 0.02)
        first = find_pupil_images(image, n_sub=N, nominal_px=NOMINAL, min_flux=0.4)
        found = refine_pupil_images([image], first, build_shadow(TELESCOPE, DIAMETER_M))
        plain = refine_pupil_images([image], first)
        rim.append((plain.centres_px - centres).mean(axis=0))
        both.append((found.centres_px - centres).mean(axis=0))
        stated.append((plain.centre_sigma_px, found.centre_sigma_px))
    by_rim, by_both = np.sqrt(np.mean(np.square(rim))), np.sqrt(np.mean(np.square(both)))
    assert by_rim > 0.02
    assert by_both < 0.7 * by_rim
    sigma = np.sqrt(np.mean(np.square(stated), axis=0))
    assert sigma[0] == pytest.approx(by_rim, rel=0.6)
    assert 0 < sigma[1] < 3 * by_both


def test_a_clean_rim_is_round() -> None:
    rng = np.random.default_rng(3)
    whole = frame(NOMINAL, rng, 0.0, noise=0.002).astype(float)
    contaminated = frame(NOMINAL, np.random.default_rng(3), 0.03, noise=0.002).astype(float)
    assert estimate_roundness_error(whole, NOMINAL, N / 2, N / 2) < 0.02
    assert estimate_roundness_error(contaminated, NOMINAL, N / 2, N / 2) > 0.04
