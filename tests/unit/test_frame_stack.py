"""Frames of a long run in bounded memory."""

from __future__ import annotations

import numpy as np
import pytest

from escape_hw.pipeline.psf.frame_stack import FrameStack


def frames(n: int) -> np.ndarray:
    return np.random.default_rng(n).integers(0, 4096, (n, 3, 5), dtype=np.uint16)


def filled(images: np.ndarray, limit: int) -> FrameStack:
    stack = FrameStack(limit)
    for image in images:
        stack.add(image)
    return stack


def test_few_frames_are_kept_as_they_are():
    images = frames(7)
    np.testing.assert_array_equal(filled(images, 8).images(), images)


@pytest.mark.parametrize("n", [8, 9, 31, 32, 100, 1000])
def test_many_frames_are_averaged_evenly_and_in_order(n):
    images = frames(n)
    stack = filled(images, 8)
    kept = stack.images()
    assert stack.count == n
    assert 4 <= len(kept) <= 8
    each = 1 << int(np.floor(np.log2(n / 4)))
    want = images[: n // each * each].astype(float).reshape(-1, each, 3, 5).mean(axis=1)
    np.testing.assert_allclose(kept, want, rtol=1e-6)


def test_without_frames_nothing_is_saved():
    assert len(FrameStack().images()) == 0
    with pytest.raises(ValueError, match="limit is 3"):
        FrameStack(3)
