"""Points of the modulator on the pyramid."""

from __future__ import annotations

import numpy as np
import pytest

from escape_sim.optics.modulation import ModulationPath, n_points


@pytest.mark.parametrize(("radius", "points"), [(0, 1), (0.1, 4), (3, 20), (5, 32)])
def test_points_follow_the_radius(radius, points):
    assert n_points(radius) == points
    assert len(ModulationPath.circle(radius).points) == points


def test_a_circle_starts_on_the_x_axis_and_goes_round_evenly():
    circle = ModulationPath.circle(3.0)
    assert circle.points[0] == pytest.approx([3, 0])
    assert circle.points[5] == pytest.approx([0, 3])
    assert np.hypot(*circle.points.T) == pytest.approx(np.full(20, 3.0))
    assert circle.points.mean(axis=0) == pytest.approx([0, 0])
    assert circle.weight == pytest.approx(0.05)


def test_an_ellipse_is_longer_one_way():
    points = ModulationPath.circle(2.0, ellipse=0.1, ellipse_angle=np.pi / 2).points
    assert np.abs(points).max(axis=0) == pytest.approx([1.9, 2.1], abs=1e-3)


def test_at_rest_the_image_is_at_the_centre():
    assert np.array_equal(ModulationPath.circle(0.0).points, [[0.0, 0.0]])


@pytest.mark.parametrize("points", [np.zeros(2), np.zeros((0, 2)), np.array([[0.0, np.nan]])])
def test_nonsense_is_refused(points):
    with pytest.raises(ValueError, match="finite and"):
        ModulationPath(points)


def test_a_negative_radius_is_refused():
    with pytest.raises(ValueError, match="cannot be negative"):
        ModulationPath.circle(-1.0)
