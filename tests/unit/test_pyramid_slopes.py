"""The compiled pyramid slopes against their definition, pixel by pixel."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from escape_hw.api.pyramid import PyramidPupils
from escape_hw.pipeline.slopes.pyramid import PyramidSlopes, slopes_of_image

SHAPE = (40, 50)
CORNERS = np.array([[3, 2], [30, 5], [1, 22], [25, 21]])
N = 12


def pupils(**more: Any) -> PyramidPupils:
    rng = np.random.default_rng(0)
    y, x = np.indices((N, N)) - (N - 1) / 2
    valid = np.hypot(x, y) < 6
    # A hole, as a spider leaves it.
    valid[5, 3:6] = False
    references = rng.normal(0, 0.1, (int(valid.sum()), 2)).astype(np.float32)
    made = PyramidPupils(
        CORNERS + (N - 1) / 2, float(N), CORNERS.astype(np.intp), valid, references, valid.astype(np.float32)
    )
    return replace(made, **more)


def counts(seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 1023, SHAPE).astype(np.uint16)


def by_hand(image: np.ndarray, grid: PyramidPupils) -> np.ndarray:
    """The definition in plain loops."""
    places = [(i, j) for i in range(N) for j in range(N) if grid.valid[i, j]]
    four = np.array([[image[y + i, x + j] for x, y in grid.corners_px] for i, j in places], float)
    light = four.sum(axis=1)
    norm = light if grid.normalisation == "local" else np.full(light.shape, light.mean())
    x = (four[:, 1] + four[:, 3] - four[:, 0] - four[:, 2]) / norm - grid.references[:, 0]
    y = (four[:, 2] + four[:, 3] - four[:, 0] - four[:, 1]) / norm - grid.references[:, 1]
    return np.concatenate([x, y])


@pytest.mark.parametrize("normalisation", ["global", "local"])
def test_slopes_are_the_definition(normalisation: str) -> None:
    rng = np.random.default_rng(2)
    grid, frame = pupils(normalisation=normalisation), counts()
    dark = rng.uniform(0, 20, SHAPE).astype(np.float32)
    flat = rng.uniform(0.9, 1.1, SHAPE).astype(np.float32)
    slopes_of = PyramidSlopes(grid, SHAPE, dark=dark, flat=flat)
    image = (frame - dark.astype(float)) / flat
    want = by_hand(image, grid)
    assert np.abs(slopes_of(frame) - want).max() < 2e-6
    assert np.abs(slopes_of_image(image, grid) - want).max() < 1e-12
    light = sum(image[y : y + N, x : x + N][grid.valid] for x, y in grid.corners_px)
    assert slopes_of.flux == pytest.approx(light, rel=1e-5)


def test_arrays_may_be_given() -> None:
    grid = pupils()
    slopes_of = PyramidSlopes(grid, SHAPE)
    out, flux = np.empty(grid.n_slopes, np.float32), np.empty(grid.n_valid, np.float32)
    assert slopes_of(counts(), flux=flux, out=out) is out
    kept = slopes_of(counts()).copy()
    assert (out == kept).all()
    assert (flux == slopes_of.flux).all()


@pytest.mark.parametrize("normalisation", ["global", "local"])
def test_darkness_gives_zero(normalisation: str) -> None:
    slopes = PyramidSlopes(pupils(normalisation=normalisation), SHAPE)(np.zeros(SHAPE, np.uint16))
    assert not slopes.any()
    assert not slopes_of_image(np.zeros(SHAPE), pupils(normalisation=normalisation)).any()


def test_light_on_the_right_is_a_positive_x_and_below_a_positive_y() -> None:
    grid = replace(pupils(), references=np.zeros((pupils().n_valid, 2), np.float32))
    slopes_of = PyramidSlopes(grid, SHAPE)
    for bright, sign_x, sign_y in ((0, -1, -1), (1, 1, -1), (2, -1, 1), (3, 1, 1)):
        frame = np.full(SHAPE, 100, np.uint16)
        x, y = CORNERS[bright]
        frame[y : y + N, x : x + N] = 200
        slopes = slopes_of(frame).reshape(2, -1)
        assert slopes[0] == pytest.approx(sign_x * 0.2)
        assert slopes[1] == pytest.approx(sign_y * 0.2)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"dark": np.zeros((3, 3), np.float32)}, "must have the region's"),
        ({"flat": np.zeros(SHAPE, np.float32)}, "not positive"),
    ],
)
def test_what_does_not_fit_is_refused(change: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        PyramidSlopes(pupils(), SHAPE, **change)


def test_images_beyond_the_region_are_refused() -> None:
    with pytest.raises(ValueError, match="leave the region"):
        PyramidSlopes(pupils(), (40, 36))
    with pytest.raises(ValueError, match="set up for"):
        PyramidSlopes(pupils(), SHAPE)(np.zeros((40, 51), np.uint16))
