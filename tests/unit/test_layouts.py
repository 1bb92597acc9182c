"""Positions of actuators by layout, and their neighbours."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.io import fits
from shared_data import shared_data

from escape_hw.api.mirror import DeformableMirror, DMInfo
from escape_hw.config import layouts
from escape_hw.config.loader import load_system, load_text
from escape_hw.deprecation import RenamedWarning
from escape_hw.errors import ConfigError
from escape_hw.safety.limits import MirrorLimits, nearest_pairs, neighbour_pairs


@pytest.mark.parametrize("n", [336, 672])
def test_rings(n):
    name = f"rings-{n}"
    at = layouts.positions(name)
    assert layouts.n_actuators(name) == n
    assert at.shape == (n, 2)
    assert not layouts.is_on_grid(name)
    radius = np.hypot(*at.T)
    levels, members = np.unique(radius.round(9), return_counts=True)
    assert tuple(members) == layouts.RINGS[n]
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
    radius = np.hypot(*layouts.positions("rings-336").T)
    assert radius.min() == pytest.approx(3.5)
    assert radius.max() == pytest.approx(10.5)


@pytest.mark.parametrize(
    "name", ["circle-11", "circle-4", "square-5", "rows:2,4,6,4,2", "map:0110/1111/0011"]
)
def test_grids(name):
    grid = layouts.layout_map(name)
    at = layouts.positions(name)
    assert len(at) == layouts.n_actuators(name) == grid.sum()
    again = np.zeros_like(grid)
    middle = (np.array(grid.shape) - 1) / 2
    again[tuple((at[:, ::-1] + middle).round().astype(int).T)] = True
    assert np.array_equal(again, grid)
    assert (np.diff(at[:, 1]) >= 0).all()


@pytest.mark.parametrize(
    "name", ["rings-335", "rings-0", "rings-", "ring-336", "hexagon-7", "circle-0", "row:3"]
)
def test_unknown_layouts_are_refused(name):
    with pytest.raises(ValueError, match=r"'circle-N', 'square-N', 'rings-672', 'maps-336', 'rows:"):
        layouts.n_actuators(name)


@pytest.mark.parametrize(
    ("layout", "text"),
    [
        ("rows:3,x", "must list whole numbers"),
        ("rows:", "must list whole numbers"),
        ("rows:0,0", "one at least"),
        ("rows:-1,3", "0 to 1000"),
        (
            "rows:3,4,3",
            "row 1 of 3 cannot be centred on a grid of 4 columns; correct the count, or .* 'mask:FILE'",
        ),
        ("map:01/1", "equal length"),
        ("map:00/00", "equal length"),
        ("points:1,2;3", "must list x,y"),
        ("points:1,2;0,0;1,2", "actuators 0 and 2 .* same position"),
        ("points:1,2;nan,0", "actuator 1 .* finite"),
        ("mask:/no/such/file", "the mask '/no/such/file' cannot be read"),
        ("positions:/no/such/file", "the table of positions '/no/such/file' cannot be read"),
    ],
)
def test_impossible_layouts_name_the_value(layout, text):
    with pytest.raises(ValueError, match=text):
        layouts.resolve_layout(layout)


def test_rows_of_a_circle():
    assert layouts.n_actuators("rows:5,7,9,11,11,11,11,11,9,7,5") == 97
    circle = layouts.layout_map("circle-11")
    assert np.array_equal(layouts.layout_map("rows:5,7,9,11,11,11,11,11,9,7,5"), circle)


def write_table(path, table):
    """A table in the format of its suffix."""
    if path.suffix == ".npy":
        np.save(path, table)
    elif path.suffix == ".fits":
        fits.writeto(path, table)
    else:
        np.savetxt(path, table, header="a comment", fmt="%.6g")


@pytest.mark.parametrize("suffix", [".txt", ".npy", ".fits"])
def test_a_mask_in_a_file_replaces_its_name(tmp_path, suffix):
    mask = np.array([[0, 1, 1, 0], [1, 1, 1, 1], [0, 1, 0, 0]])
    path = tmp_path / f"mask{suffix}"
    write_table(path, mask)
    layout = layouts.resolve_layout(f"mask:{path}")
    assert layout == "map:0110/1111/0100"
    assert layouts.n_actuators(layout) == 7


def test_a_mask_of_text_needs_no_spaces(tmp_path):
    path = tmp_path / "mask"
    path.write_text("0110  # top\n\n1111\n")
    assert layouts.resolve_layout(f"mask:{path}") == "map:0110/1111"


@pytest.mark.parametrize("suffix", [".txt", ".npy", ".fits"])
@pytest.mark.parametrize("first", [None, 0, 1])
def test_positions_in_a_file_are_in_the_order_of_their_numbers(tmp_path, suffix, first):
    at = np.array([[0.5, -0.25], [0.0, 1.5], [-2.0, 0.0]])
    table = at if first is None else np.column_stack([[first, first + 1, first + 2], at])[[2, 0, 1]]
    path = tmp_path / f"positions{suffix}"
    write_table(path, table)
    layout = layouts.resolve_layout(f"positions:{path}")
    assert np.array_equal(layouts.positions(layout), at)
    assert not layouts.is_on_grid(layout)


def test_a_table_of_positions_must_be_complete(tmp_path):
    path = tmp_path / "positions.txt"
    path.write_text("0 0 0\n2 1 0\n")
    with pytest.raises(ValueError, match="number its 2 actuators from 0 or 1"):
        layouts.resolve_layout(f"positions:{path}")
    path.write_text("0 0 0 1\n")
    with pytest.raises(ValueError, match="has 4 columns; it needs x, y or number, x, y"):
        layouts.resolve_layout(f"positions:{path}")


def test_the_configuration_keeps_the_content_of_a_file(tmp_path):
    path = tmp_path / "positions.txt"
    np.savetxt(path, layouts.positions("circle-11") * 2 / 9.0, header="x y in pupil radii")
    changes = (f"devices.dm.layout=positions:{path}", "devices.dm.position_unit=pupil-radius")
    config = load_system("razor-shwfs", overrides=changes)
    path.unlink()
    again = load_text(config.to_toml())
    assert again == config
    assert again.devices.dm.positions() == pytest.approx(layouts.positions("circle-11"), abs=1e-7)
    assert again.devices.dm.actuator_map() is None
    rows = load_system("razor-shwfs", overrides=["devices.dm.layout=rows:5,7,9,11,11,11,11,11,9,7,5"])
    assert np.array_equal(rows.devices.dm.actuator_map(), layouts.layout_map("circle-11"))


@pytest.mark.parametrize(
    ("override", "text"),
    [
        (
            "devices.dm.layout=mask:/none.txt",
            r"devices\.dm\.layout: .*'/none\.txt' cannot be read \(No such file",
        ),
        ("devices.dm.position_unit=metre", "devices.dm.position_unit: .*remove it"),
        (
            "sensor.valid=rows:2,4,4,2",
            "sensor.valid: .*has 4 rows of 4; n_sub = 24 needs 24 rows of 24 columns",
        ),
        ("sensor.valid=maps-336", "sensor.valid: .*is not on a grid; n_sub = 24"),
    ],
)
def test_wrong_layouts_in_a_configuration(override, text):
    with pytest.raises(ConfigError, match=text):
        load_system("razor-shwfs", overrides=[override])


def test_the_guessed_layout_of_the_mmt_is_deprecated():
    with pytest.warns(RenamedWarning, match="'maps-336' has the published positions"):
        load_system("maps-nir", overrides=["devices.dm.layout=rings-336"])


def test_the_mirror_of_the_mmt_has_ten_rings():
    at = layouts.positions("maps-336") / layouts.MAPS_PITCHES
    assert at.shape == (336, 2)
    radii = np.sort(np.hypot(*at.T))
    steps = np.flatnonzero(np.diff(radii) > 0.01)
    assert list(np.diff([-1, *steps, 335])) == [6, 12, 18, 24, 30, 36, 42, 48, 60, 60]
    assert (radii[0], radii[-1]) == pytest.approx((0.1315, 0.9755))


def test_the_mirror_of_the_mmt_is_that_of_the_published_table():
    table = shared_data("maps") / "act2Dpos.txt"
    published = layouts.positions(layouts.resolve_layout(f"positions:{table}"))
    assert layouts.positions("maps-336") / layouts.MAPS_PITCHES == pytest.approx(published, abs=0.0015)


def test_rings_have_no_grid():
    with pytest.raises(ValueError, match="not on a grid"):
        layouts.layout_map("rings-336")


@pytest.mark.parametrize("name", ["circle-11", "circle-6", "square-4"])
def test_nearest_pairs_on_a_grid_are_the_grids(name):
    want = {tuple(sorted(map(int, pair))) for pair in neighbour_pairs(layouts.layout_map(name))}
    found = nearest_pairs(layouts.positions(name) * 1.5e-3)
    assert {tuple(map(int, pair)) for pair in found} == want
    assert len(found) == len(want)


def test_nearest_pairs_on_rings():
    at = layouts.positions("rings-336")
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
        places = layouts.positions("rings-336") * 0.03
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
