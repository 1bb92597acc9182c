"""A lenslet's response along and across its slopes, which SPRINT does not take for scalings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from escape_hw.api.registration import Registration
from escape_hw.config.loader import load_system
from escape_sim.models.shack_hartmann import ShackHartmannModel, nominal_grid

GAUSSIAN = ["devices.dm.influence=gaussian", "devices.dm.coupling=0.4"]


@pytest.fixture(scope="module")
def model():
    config = load_system("razor-shwfs", overrides=GAUSSIAN)
    return ShackHartmannModel(config, nominal_grid(config))


def test_change_is_the_difference_of_second_derivatives(model):
    """Derivative by the logarithm of a Gaussian's width: the second by position, times the variance."""
    at, step = Registration(shift_x=20.0, shift_y=-35.0, rotation=1.0), 2.0
    (anisotropic,) = model.variants()
    change = anisotropic.zonal_matrix(at) - model.zonal_matrix(at)

    def pair(axis):
        moved = (replace(at, **{axis: getattr(at, axis) + sign * step}) for sign in (1, -1))
        return sum(model.zonal_matrix(one) for one in moved)

    positions = model.actuator_positions_m
    pitch = 100 * np.linalg.norm(positions[1] - positions[0]) / model.sub_aperture_m
    variance = pitch**2 / (2 * np.log(1 / 0.4))
    expected = 0.02 * variance * (pair("shift_x") - pair("shift_y")) / step**2
    half = len(expected) // 2
    expected[half:] *= -1
    assert np.abs(change - expected).max() < 0.02 * np.abs(change).max()


def test_mirrors_of_any_shape_have_the_variant():
    config = load_system("razor-shwfs", overrides=["devices.dm.influence=thin-plate"])
    plate = ShackHartmannModel(config, nominal_grid(config))
    (anisotropic,) = plate.variants()
    assert np.isfinite(anisotropic.zonal_matrix(Registration())).all()
    assert not np.array_equal(anisotropic.zonal_matrix(Registration()), plate.zonal_matrix(Registration()))
