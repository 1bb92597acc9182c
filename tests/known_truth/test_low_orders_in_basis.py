"""Tip, tilt and focus are within the Karhunen-Loeve modes of telescopes with fewer modes than actuators."""

from __future__ import annotations

import numpy as np
import pytest

from escape_hw.calibration.modes.bases import build_basis
from escape_hw.config.loader import load_system
from escape_hw.config.registry import model_factory


@pytest.mark.parametrize(
    ("name", "most"),
    # On MAPS ten disabled actuators are not available.
    [("revolt-shwfs", 0.03), ("maps-nir", 0.06)],
)
def test_low_orders_are_within_the_modes(name, most):
    config = load_system(name)
    surfaces, pupil, pixel_m = model_factory("fast")(config, None).influence_functions()
    m2c = build_basis(config, surfaces, pupil, pixel_m, config.devices.dm.limits.disabled)
    assert m2c.shape[1] == 100
    y, x = (np.indices(pupil.shape)[axis][pupil].astype(float) for axis in (0, 1))
    x, y = x - x.mean(), y - y.mean()
    modes = np.column_stack([surfaces[:, pupil].T @ m2c, np.ones(x.size)])
    for shape in (x, y, x**2 + y**2):
        left = shape - modes @ np.linalg.lstsq(modes, shape, rcond=None)[0]
        assert left.std() < most * shape.std()
    # Not at the price of large commands.
    assert np.abs(m2c).max() < 8
