"""The flat: relative response of the pixels in uniform light."""

from __future__ import annotations

import numpy as np
import pytest

from escape_hw.calibration.acquisition.sensor_setup import compute_flat
from escape_hw.errors import CalibrationError


def test_the_response_of_the_pixels_is_found_and_defective_pixels_get_one() -> None:
    rng = np.random.default_rng(2)
    response = rng.normal(1.0, 0.02, (60, 80))
    dark = rng.uniform(20, 30, (60, 80)).astype(np.float32)
    mean = (400 * response + dark).astype(np.float32)
    mean[7, 9], mean[40, 3] = dark[7, 9], 10_000
    flat = compute_flat(mean, dark)
    assert flat.mean() == pytest.approx(1.0, abs=1e-6)
    assert flat[[7, 40], [9, 3]] == pytest.approx(1.0, abs=0.005)
    good = np.ones(flat.shape, bool)
    good[[7, 40], [9, 3]] = False
    assert flat[good] == pytest.approx((response / response.mean())[good], abs=0.005)


def test_light_that_is_missing_or_not_uniform_is_refused() -> None:
    dark = np.full((50, 50), 20.0, np.float32)
    with pytest.raises(CalibrationError, match="no light"):
        compute_flat(dark, dark)
    spots = dark + 100
    spots[::5, ::5] = 900
    with pytest.raises(CalibrationError, match=r"4.0 % of the pixels .* uniform light"):
        compute_flat(spots, dark)
