"""Positions of actuators by layout, and their neighbours."""

from __future__ import annotations

import numpy as np
import pytest

from escape_hw.api.mirror import DeformableMirror, DMInfo
from escape_hw.config import actuator_layouts
from escape_hw.safety.limits import MirrorLimits, nearest_pairs, neighbour_pairs


@pytest.mark.parametrize("n", [336, 672])
def test_rings(n):
    name = f"rings-{n}"
    at = actuator_layouts.positions(name)
    assert actuator_layouts.n_actuators(name) == n
    assert at.shape == (n, 2)
    assert not actuator_layouts.is_on_grid(name)
    radius = np.hypot(*at.T)
    levels, members = np.unique(radius.round(9), return_counts=True)
    assert tuple(members) == actuator_layouts.RINGS[n]
    assert np.diff(levels) == pytest.approx(1.0)
    # Numbered outwards, and along each ring from +x towards +y.
    assert (np.diff(radius) > -1e-9).all()
    assert at[0, 0] > 0
    assert 0 < at[0, 1] < 1
    assert at.mean(axis=0) == pytest.approx([0, 0], abs=1e-12)
    distance = np.hypot(*(at[:, None, k] - at[:, k] for k in (0, 1))) + 99 * np.eye(n)
    assert distance.min() > 0.95
    assert distance.min(axis=1).max() < 1.05


def test_the_mmt_mirror_has_a_hole():
    radius = np.hypot(*actuator_layouts.positions("rings-336").T)
    assert radius.min() == pytest.approx(3.5)
    assert radius.max() == pytest.approx(10.5)


@pytest.mark.parametrize("name", ["circle-11", "circle-4", "square-5"])
def test_grids(name):
    grid = actuator_layouts.actuator_map(name)
    at = actuator_layouts.positions(name)
    assert len(at) == actuator_layouts.n_actuators(name) == grid.sum()
    again = np.zeros_like(grid)
    middle = (len(grid) - 1) / 2
    again[tuple((at[:, ::-1] + middle).round().astype(int).T)] = True
    assert np.array_equal(again, grid)
    assert (np.diff(at[:, 1]) >= 0).all()


@pytest.mark.parametrize("name", ["rings-335", "rings-0", "rings-", "ring-336", "hexagon-7", "circle-0"])
def test_unknown_layouts_are_refused(name):
    with pytest.raises(ValueError, match=r"'circle-N', 'square-N', 'rings-336'"):
        actuator_layouts.n_actuators(name)


def test_rings_have_no_grid():
    with pytest.raises(ValueError, match="not on a grid"):
        actuator_layouts.actuator_map("rings-336")


@pytest.mark.parametrize("name", ["circle-11", "circle-6", "square-4"])
def test_nearest_pairs_on_a_grid_are_the_grids(name):
    want = {tuple(sorted(map(int, pair))) for pair in neighbour_pairs(actuator_layouts.actuator_map(name))}
    found = nearest_pairs(actuator_layouts.positions(name) * 1.5e-3)
    assert {tuple(map(int, pair)) for pair in found} == want
    assert len(found) == len(want)


def test_nearest_pairs_on_rings():
    at = actuator_layouts.positions("rings-336")
    pairs = nearest_pairs(at)
    distance = np.hypot(*(at[pairs[:, 0]] - at[pairs[:, 1]]).T)
    assert distance.max() < 1.3 * 1.05
    ring = np.round(np.hypot(*at.T) - 3.5).astype(int)
    along, across = (
        pairs[ring[pairs[:, 0]] == ring[pairs[:, 1]]],
        pairs[ring[pairs[:, 0]] != ring[pairs[:, 1]]],
    )
    # Every actuator has both neighbours on its ring, and one at least on the next ring.
    assert len(along) == 336
    assert set(np.unique(across)) == set(range(336))
    assert np.abs(np.diff(ring[across], axis=1)).max() == 1


@pytest.mark.parametrize(
    ("positions", "text"),
    [
        (np.zeros((5, 3)), r"\(5, 3\)"),
        (np.full((3, 2), np.nan), "finite"),
        (np.array([[0.0, 0], [1, 0], [1, 0]]), "actuators 1 and 2 have the same position"),
    ],
)
def test_impossible_positions_are_refused(positions, text):
    with pytest.raises(ValueError, match=text):
        nearest_pairs(positions)


def test_one_actuator_has_no_neighbour():
    assert nearest_pairs(np.zeros((1, 2))).shape == (0, 2)


class RingMirror(DeformableMirror):
    """Records what is sent to a mirror without a grid."""

    def __init__(self, limits):
        super().__init__("rings", limits)
        self.sent = []
        places = actuator_layouts.positions("rings-336") * 0.03
        self._info = DMInfo("rings", "R1", 336, None, places, 1e-5, True)

    @property
    def info(self):
        return self._info

    def _open(self):
        pass

    def _close(self):
        pass

    def _send(self, command):
        self.sent.append(command)


def test_the_guard_limits_neighbours_without_a_grid():
    with RingMirror(MirrorLimits(max_neighbour=0.1)) as mirror:
        spike = np.zeros(336)
        spike[100] = 0.5
        report = mirror.send(spike)
        assert report.guard.scale == pytest.approx(0.2)
        # A smooth tilt of the same height passes.
        tilt = 0.5 * mirror.info.positions_m[:, 0] / np.abs(mirror.info.positions_m).max()
        assert mirror.send(tilt).guard.is_unchanged
