"""The compiled centre of gravity against a NumPy implementation."""

from __future__ import annotations

import numpy as np
import pytest

from escape_hw.api.sensor import SubApertureGrid
from escape_hw.pipeline.slopes.shack_hartmann import ShackHartmannSlopes, subaperture_windows

SHAPES = {
    "whole pixels": (6, 8.0, (3.5, 3.5), (48, 48)),
    "bench": (10, 15.55, (12.3, 14.7), (170, 175)),
    "small windows": (12, 3.3, (2.0, 1.2), (41, 39)),
    "cut at the edge": (5, 9.0, (1.0, 2.0), (36, 33)),
    "one window as wide as the camera": (1, 6.0, (2.5, 2.5), (6, 6)),
}


def by_hand(grid, frame, dark, flat, threshold):
    light = np.maximum((frame.astype(float) - dark) / flat - threshold, 0)
    slopes, flux = [], []
    centres = grid.centres_px()
    boxes = subaperture_windows(centres, grid.pitch_px, frame.shape)
    for (x, y), (top, end, left, right), reference in zip(centres, boxes, grid.references_px, strict=True):
        part = light[top:end, left:right]
        total = part.sum()
        at = (part.sum(0) @ np.arange(left, right), part.sum(1) @ np.arange(top, end))
        slopes.append([at[0] / total - x, at[1] / total - y] - reference if total else [0, 0])
        flux.append(total)
    return np.array(slopes).T.ravel(), np.array(flux)


def make(case):
    n, pitch, origin, shape = SHAPES[case]
    rng = np.random.default_rng(3)
    valid = rng.random((n, n)) < 0.8
    valid[0, 0] = True
    references = rng.normal(0, 0.3, (int(valid.sum()), 2)).astype(np.float32)
    grid = SubApertureGrid(pitch, origin, valid, references, valid.astype(np.float32))
    frame = rng.integers(0, 1024, shape).astype(np.uint16)
    dark = rng.uniform(5, 15, shape).astype(np.float32)
    flat = rng.uniform(0.9, 1.1, shape).astype(np.float32)
    return grid, frame, dark, flat


@pytest.mark.parametrize("case", SHAPES)
@pytest.mark.parametrize("threshold", [0.0, 300.0, 960.0])
def test_slopes_and_flux_are_right(case, threshold):
    grid, frame, dark, flat = make(case)
    extractor = ShackHartmannSlopes(grid, frame.shape, dark=dark, flat=flat, threshold=threshold)
    flux = np.zeros(grid.n_valid, np.float32)
    slopes = extractor(frame, flux)
    want, light = by_hand(grid, frame, dark, flat, threshold)
    assert slopes == pytest.approx(want, abs=2e-4)
    assert flux == pytest.approx(light, rel=1e-4, abs=1e-2)


def test_slopes_without_dark_and_flat():
    grid, frame, _, _ = make("bench")
    want, _ = by_hand(grid, frame, 0.0, 1.0, 0.0)
    assert ShackHartmannSlopes(grid, frame.shape)(frame) == pytest.approx(want, abs=1e-4)


def test_a_dark_window_yields_zero():
    grid, frame, _, _ = make("bench")
    flux = np.ones(grid.n_valid, np.float32)
    slopes = ShackHartmannSlopes(grid, frame.shape, threshold=2000.0)(frame, flux)
    assert not slopes.any()
    assert not flux.any()


def test_pixels_outside_a_window_do_not_matter():
    grid, frame, _, _ = make("bench")
    extractor = ShackHartmannSlopes(grid, frame.shape)
    before = extractor(frame)
    outside = np.ones(frame.shape, bool)
    for top, end, left, right in subaperture_windows(grid.centres_px(), grid.pitch_px, frame.shape):
        outside[top:end, left:right] = False
    assert outside.any()
    frame[outside] = 1023
    assert np.array_equal(extractor(frame), before)


def test_read_only_and_cut_out_frames_give_the_same():
    grid, frame, dark, flat = make("bench")
    extractor = ShackHartmannSlopes(grid, frame.shape, dark=dark, flat=flat, threshold=50.0)
    want = extractor(frame)
    large = np.zeros((200, 220), np.uint16)
    large[9:179, 13:188] = frame
    cut_out = large[9:179, 13:188]
    assert np.array_equal(extractor(cut_out), want)
    cut_out.flags.writeable = False
    assert np.array_equal(extractor(cut_out), want)


def test_the_result_can_be_put_where_the_caller_wants():
    grid, frame, _, _ = make("bench")
    extractor = ShackHartmannSlopes(grid, frame.shape)
    out = np.empty(grid.n_slopes, np.float32)
    assert extractor(frame, None, out) is out
    assert np.array_equal(out, extractor(frame))


def test_wrong_shapes_are_refused():
    grid, frame, dark, flat = make("bench")
    with pytest.raises(ValueError, match="frame has shape"):
        ShackHartmannSlopes(grid, frame.shape)(frame[:-1])
    with pytest.raises(ValueError, match="dark"):
        ShackHartmannSlopes(grid, frame.shape, dark=dark[:-1])
    flat[3, 4] = 0
    with pytest.raises(ValueError, match="not positive"):
        ShackHartmannSlopes(grid, frame.shape, flat=flat)
