"""Registration: order, units and the direction of every parameter."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from escape_hw.api.registration import PARAMETERS, UNITS, Registration

EAST, SOUTH = np.array([1.0, 0.0]), np.array([0.0, 1.0])


def placed(point: np.ndarray, **parameters: float) -> np.ndarray:
    """Where an actuator at ``point`` metres stands; sub-apertures of 0.5 m."""
    matrix, offset = Registration(**parameters).affine(0.5)
    return np.asarray(matrix @ point + offset)


def test_the_nominal_registration_moves_nothing() -> None:
    np.testing.assert_array_equal(placed(np.array([0.3, -0.7])), [0.3, -0.7])


def test_shifts_are_percents_of_a_sub_aperture() -> None:
    np.testing.assert_allclose(placed(np.zeros(2), shift_x=100.0), [0.5, 0.0])
    np.testing.assert_allclose(placed(np.zeros(2), shift_y=-20.0), [0.0, -0.1])


def test_a_positive_rotation_turns_x_towards_y() -> None:
    np.testing.assert_allclose(placed(EAST, rotation=90.0), SOUTH, atol=1e-15)
    np.testing.assert_allclose(placed(SOUTH, rotation=90.0), -EAST, atol=1e-15)


def test_scalings_stretch_along_x_and_along_y() -> None:
    np.testing.assert_allclose(placed(EAST + SOUTH, radial_scaling=3.0), [1.03, 1.0])
    np.testing.assert_allclose(placed(EAST + SOUTH, tangential_scaling=-2.0), [1.0, 0.98])


def test_scaling_comes_before_rotation_and_rotation_before_shift() -> None:
    where = placed(EAST, radial_scaling=10.0, rotation=90.0, shift_x=100.0)
    np.testing.assert_allclose(where, [0.5, 1.1], atol=1e-15)


@given(st.lists(st.floats(-100, 100), min_size=5, max_size=5))
def test_arrays_and_dictionaries_keep_the_order(values: list[float]) -> None:
    registration = Registration.from_array(values)
    assert registration.to_array().tolist() == values
    assert list(registration.to_dict()) == list(PARAMETERS)
    assert Registration(**registration.to_dict()) == registration


def test_every_parameter_has_a_unit() -> None:
    assert set(UNITS) == set(PARAMETERS)


@pytest.mark.parametrize("size", [4, 6])
def test_five_numbers_are_needed(size: int) -> None:
    with pytest.raises(ValueError, match="reshape"):
        Registration.from_array(np.zeros(size))


@pytest.mark.parametrize(
    ("changes", "displacement"),
    [
        ({}, 0.0),
        ({"shift_x": 3.0, "shift_y": -4.0}, 5.0),
        # A degree at ten sub-apertures from the centre; a per cent there.
        ({"rotation": 1.0}, 2 * 1000 * np.sin(np.deg2rad(0.5))),
        ({"radial_scaling": 1.0}, 10.0),
    ],
)
def test_displacement_is_that_of_the_edge_of_the_pupil(
    changes: dict[str, float], displacement: float
) -> None:
    start = Registration()
    found = Registration(**changes).largest_displacement(start, radius=10.0)
    assert found == pytest.approx(displacement, rel=1e-9)


def test_the_anamorphosis_angle_turns_the_scalings_from_y_towards_x() -> None:
    both = {"radial_scaling": 10.0, "tangential_scaling": -10.0, "anamorphosis_angle": 45.0}
    np.testing.assert_allclose(placed(EAST - SOUTH, **both), 1.1 * (EAST - SOUTH))
    np.testing.assert_allclose(placed(EAST + SOUTH, **both), 0.9 * (EAST + SOUTH))
    turned = Registration(**both)
    assert turned.to_dict()["anamorphosis_angle"] == 45.0
    assert Registration(**turned.to_dict()) == turned
    assert turned.to_array().size == 5


@pytest.mark.parametrize(
    ("given", "stored"),
    [(180.0, 180.0), (-180.0, 180.0), (180.5, -179.5), (348.0, -12.0), (-348.0, 12.0), (720.25, 0.25)],
)
def test_rotations_are_stored_between_minus_and_plus_180_degrees(given: float, stored: float) -> None:
    turned = Registration(rotation=given)
    assert turned.rotation == pytest.approx(stored)
    assert Registration.from_array(turned.to_array()) == turned
    assert Registration.from_array([0, 0, given, 0, 0]) == turned
    np.testing.assert_allclose(placed(EAST, rotation=given), placed(EAST, rotation=stored), atol=1e-12)


def test_a_rotation_within_the_range_keeps_its_last_bit() -> None:
    value = float(np.nextafter(-0.743, 0))
    assert Registration(rotation=value).rotation == value
    assert np.isnan(Registration(rotation=np.nan).rotation)
