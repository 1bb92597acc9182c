"""Points of the modulator on the pyramid."""

from __future__ import annotations

import numpy as np
import pytest

from escape_sim.optics.modulation import ModulationPath, n_points


@pytest.mark.parametrize(("radius", "points"), [(0, 1), (0.1, 4), (3, 20), (5, 32)])
def test_points_follow_the_radius(radius, points):
    assert n_points(radius) == points
    assert ModulationPath.circle(radius).n_points == points


def test_a_circle_starts_on_the_x_axis_and_goes_round_evenly():
    circle = ModulationPath.circle(3.0)
    assert circle.points[0] == pytest.approx([3, 0])
    assert circle.points[5] == pytest.approx([0, 3])
    assert np.hypot(*circle.points.T) == pytest.approx(np.full(20, 3.0))
    assert circle.points.mean(axis=0) == pytest.approx([0, 0])
    assert circle.weights == pytest.approx(np.full(20, 0.05))


def test_an_ellipse_is_longer_one_way():
    ellipse = ModulationPath.circle(2.0, 400, ellipse=0.1, ellipse_angle=np.pi / 2, centre=(0.5, -1.0))
    low, high = ellipse.points.min(axis=0), ellipse.points.max(axis=0)
    assert (high - low) / 2 == pytest.approx([1.9, 2.1], abs=1e-3)
    assert (high + low) / 2 == pytest.approx([0.5, -1.0], abs=1e-3)


def test_a_phase_turns_the_first_point():
    assert ModulationPath.circle(2.0, phase=np.pi / 2).points[0] == pytest.approx([0, 2])


def test_at_rest_the_image_is_at_the_centre():
    assert np.array_equal(ModulationPath.circle(0.0, centre=(0.1, 0.2)).points, [[0.1, 0.2]])


def test_weights_are_shares():
    assert ModulationPath(np.zeros((2, 2)), np.array([1.0, 3.0])).weights == pytest.approx([0.25, 0.75])


@pytest.mark.parametrize(
    ("points", "weights", "message"),
    [
        (np.zeros(2), np.empty(0), "finite and"),
        (np.zeros((0, 2)), np.empty(0), "finite and"),
        (np.array([[0.0, np.nan]]), np.empty(0), "finite and"),
        (np.zeros((2, 2)), np.ones(3), "as many weights"),
        (np.zeros((2, 2)), np.array([1.0, -1.0]), "none negative"),
        (np.zeros((2, 2)), np.zeros(2), "not all zero"),
    ],
)
def test_nonsense_is_refused(points, weights, message):
    with pytest.raises(ValueError, match=message):
        ModulationPath(points, weights)


def test_a_negative_radius_is_refused():
    with pytest.raises(ValueError, match="cannot be negative"):
        ModulationPath.circle(-1.0)
