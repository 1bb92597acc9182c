"""Weights by distance: summed along rows and columns, or pair by pair."""

from __future__ import annotations

import numpy as np

from escape_hw.calibration.covariance import _gathered, _nearness


def test_sums_by_nearness_two_ways():
    rng = np.random.default_rng(2)
    valid = rng.random((7, 9)) > 0.3
    scores = rng.standard_normal((3, int(valid.sum())))
    np.testing.assert_allclose(_gathered(valid, scores), scores @ _nearness(valid), atol=1e-12)


def test_nearness_falls_to_nothing_at_half_the_pupil():
    near = _nearness(np.ones((1, 11), bool))
    np.testing.assert_allclose(near[0], np.maximum(1 - np.arange(11) / 5.5, 0))
    assert np.linalg.eigvalsh(_nearness(np.ones((6, 8), bool))).min() > -1e-12
