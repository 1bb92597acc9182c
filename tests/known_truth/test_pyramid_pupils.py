"""Pupil images at known positions: located to a tenth of a pixel, or refused with a reason."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pupil_frames import NOMINAL, N, disk, frame, moved

from escape_hw.api.pyramid import PyramidPupils, remove_low_orders
from escape_hw.errors import CalibrationError
from escape_hw.pipeline.geometry.pupil_images import find_pupil_images, refine_pupil_images

SEEDS = range(8)


def find(image: np.ndarray, **more: Any) -> PyramidPupils:
    settings: dict[str, Any] = {"n_sub": N, "nominal_px": NOMINAL, "min_flux": 0.25}
    return find_pupil_images(image, **{**settings, **more})


@pytest.mark.parametrize(
    ("light", "bound"),
    [
        ({}, 0.01),
        ({"noise": 5.0, "background": 3.0}, 0.02),
        ({"strength": 0.25, "noise": 5.0}, 0.1),
    ],
    ids=["even", "noise and offset", "uneven by a quarter"],
)
@pytest.mark.slow
def test_centres_are_found(light: dict[str, float], bound: float) -> None:
    errors = []
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        centres = moved(rng)
        errors.append(find(frame(centres, rng, **light)).centres_px - centres)
    # Eight seeds of eight coordinates: the rms itself is known to a tenth.
    assert np.sqrt(np.mean(np.square(errors))) < bound
    assert np.abs(np.mean(errors, axis=0)).max() < bound


def test_centres_may_lie_far_from_the_nominal_ones() -> None:
    rng = np.random.default_rng(1)
    centres = NOMINAL + np.array([[9.3, -11.2], [-7.9, -12.4], [8.1, 14.6], [9.7, 13.2]])
    found = find(frame(centres, rng, noise=3.0))
    assert np.abs(found.centres_px - centres).max() < 0.05


@pytest.mark.parametrize("diameter", [62.6, 64.0, 65.3])
def test_diameter(diameter: float) -> None:
    rng = np.random.default_rng(2)
    found = find(frame(moved(rng), rng, diameter=diameter, noise=3.0))
    assert found.diameter_px == pytest.approx(diameter, abs=0.1)


def test_boxes_lie_within_half_a_pixel() -> None:
    rng = np.random.default_rng(3)
    found = find(frame(moved(rng), rng, noise=3.0))
    assert found.corners_px.dtype == np.intp
    assert np.abs(found.corners_px + (N - 1) / 2 - found.centres_px).max() <= 0.5


def test_valid_pixels_are_those_with_light() -> None:
    centres = np.rint(NOMINAL) - 0.5
    image = np.zeros((192, 192))
    shade = 1 - 0.9 * (np.arange(N) > 40)
    for cx, cy in centres:
        left = int(cx - (N - 1) / 2)
        part = disk(np.array([cx, cy]), N) * 200
        part[:, left : left + N] *= shade
        image += part
    found = find(image.astype(np.float32))
    inside = disk(np.array([(N - 1) / 2] * 2), N, (N, N)) > 0.5
    assert not found.valid[:, 41:].any()
    assert (found.valid[:, :40] == inside[:, :40]).mean() > 0.99
    assert found.counts == pytest.approx(800, rel=0.01)
    assert np.median(found.flux[found.valid]) == pytest.approx(1, abs=0.01)


def test_a_longer_recording_moves_centres_and_nothing_else() -> None:
    rng = np.random.default_rng(4)
    centres = moved(rng)
    first = find(frame(centres, rng, strength=0.5, noise=5.0))
    long = np.mean([frame(centres, rng, strength=0.5, noise=1.0) for _ in range(12)], axis=0)
    better = refine_pupil_images([long], first)
    assert np.abs(better.centres_px - centres).max() < 0.1
    assert better.corners_px is first.corners_px
    assert better.valid is first.valid
    assert better.references is first.references


@pytest.mark.slow
def test_parts_of_a_run_give_the_error_of_the_images_position() -> None:
    pulls = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        centres = moved(rng)
        parts = [frame(centres, rng, strength=0.5, noise=20.0).astype(np.float32) for _ in range(6)]
        found = refine_pupil_images(parts, find(parts[0]))
        assert 0 < found.centre_sigma_px < 0.1
        pulls.append((found.centres_px - centres).mean(axis=0) / found.centre_sigma_px)
    # On the safe side: what noise makes of a rim that is round passes for dirt.
    assert 0.1 < np.mean(np.square(pulls)) < 6


def test_references_are_the_mean_slopes_or_what_is_not_smooth_in_them() -> None:
    rng = np.random.default_rng(5)
    image = frame(NOMINAL, rng, noise=2.0)
    # A tilt: the images on the right are brighter. One odd column in one image belongs to the sensor.
    image[:, 96:] *= 1.2
    image[16:80, 50] *= 0.5
    mean, design = find(image), find(image, references="design")
    assert mean.references[:, 0].mean() == pytest.approx(0.4 / 4.4, abs=0.005)
    assert abs(design.references[:, 0].mean()) < 0.005
    column = np.nonzero(mean.valid)[1] == 50 - mean.corners_px[0, 0]
    inner = column & (np.abs(np.nonzero(mean.valid)[0] - 31.5) < 20)
    for pupils in (mean, design):
        odd = pupils.references[inner, 0].mean() - pupils.references[~column, 0].mean()
        assert odd == pytest.approx(0.5 / 4.4, abs=0.02)


def test_low_orders_are_polynomials_of_the_second_degree() -> None:
    y, x = (np.indices((N, N)) - 31.5) / 32
    valid = np.hypot(x, y) < 1
    smooth = np.stack([0.3 + x - 0.5 * x * y, -0.2 * y + y * y], axis=2)[valid]
    flux = np.ones((N, N), np.float32)
    assert np.abs(remove_low_orders(smooth, valid, flux)).max() < 1e-12
    waves = np.stack([np.sin(9 * x), np.cos(11 * y)], axis=2)[valid]
    left = remove_low_orders(waves, valid, flux)
    assert np.std(left - waves) < 0.2 * np.std(waves)


@pytest.mark.parametrize(
    ("image", "words"),
    [
        (np.zeros((192, 192)), "no pupil images"),
        (np.full((192, 192), 200.0), "no pupil images"),
        (np.random.default_rng(0).normal(0, 3, (192, 192)), "no pupil images"),
        (
            frame(NOMINAL[:3], np.random.default_rng(0), noise=3.0),
            r"only 3 of four .*lower right \(near x 130",
        ),
        (frame(NOMINAL[1:2], np.random.default_rng(0), noise=3.0), "only 1 of four"),
        (frame(NOMINAL - [[30, 0]] * 4, np.random.default_rng(0), noise=3.0), "missing|cuts|no clear rim"),
        (
            frame(NOMINAL - [[16, 0]] * 4, np.random.default_rng(0), noise=3.0),
            "cuts the upper left and lower left",
        ),
        (
            frame(NOMINAL, np.random.default_rng(0), diameter=54.0, noise=3.0),
            r"5[34]\.\d pixels across.*n_sub says 64",
        ),
    ],
    ids=["dark", "glow", "noise", "three", "one", "far off", "cut", "small"],
)
def test_what_is_not_four_whole_images_is_refused(image: np.ndarray, words: str) -> None:
    with pytest.raises(CalibrationError, match=words):
        find(image.astype(np.float32))


def test_unknown_references_are_refused() -> None:
    with pytest.raises(ValueError, match="'mean' or 'design'"):
        find(np.zeros((192, 192), np.float32), references="lattice")
