"""Measured influence functions from files: place, units, sign, gaps and noise."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

from escape_hw.api.registration import Registration
from escape_hw.config.layouts import grid_positions
from escape_hw.errors import ConfigError
from escape_sim.mirror.influence_functions import InfluenceFunctions
from escape_sim.mirror.influence_maps import MapSettings, fill_gaps, filter_noise, read_cube, read_maps
from escape_sim.mirror.measured import MeasuredInfluenceFunctions

N = 7
GRID = np.hypot(*(np.indices((N, N)) - N // 2)) < 3.5
LAYOUT = grid_positions(GRID)
#: Pixels per pitch, and the coordinates of the pixels in pitches.
FINE = 8
X = np.arange(-38, 39) / FINE


def truth(x: np.ndarray = X, y: np.ndarray = X) -> np.ndarray:
    return InfluenceFunctions(LAYOUT, 1.0, 0.4).surfaces(Registration(), 1.0, x, y)


def written(folder: Path, cube: np.ndarray, **cards: object) -> str:
    path = folder / "maps.fits"
    fits.writeto(path, cube, fits.Header(cards), overwrite=True)
    return str(path)


def on_the_mirror(file: str, settings: MapSettings | None = None) -> np.ndarray:
    """Surfaces of a file on the mirror's own grid, of 1.5 to 4 pitches."""
    maps = read_maps(file, LAYOUT, settings)
    functions = MeasuredInfluenceFunctions(
        maps.surfaces, maps.pixel, positions_m=maps.positions, centre_px=maps.centre_px,
        orientation=maps.orientation,
    )  # fmt: skip
    return functions.surfaces(Registration(), 1.0, X[8:-8], X[8:-8])


WANTED = truth(X[8:-8], X[8:-8])


@pytest.mark.parametrize("turned", [0, 1, 2, 3])
@pytest.mark.parametrize("mirrored", [False, True])
def test_maps_of_any_orientation_are_placed_by_their_actuators(
    turned: int, mirrored: bool, tmp_path: Path
) -> None:
    cube = np.rot90(truth(), turned, axes=(1, 2))
    cube = cube[:, :, ::-1] if mirrored else cube
    # Not centred, and not square.
    found = on_the_mirror(written(tmp_path, 3.0 * cube[:, :-5, 3:]))
    assert np.abs(found - WANTED).max() < 4e-3


def test_a_camera_at_an_angle_is_turned_back(tmp_path: Path) -> None:
    functions = MeasuredInfluenceFunctions(truth(), 1 / FINE)
    cube = functions.surfaces(Registration(30.0, -20.0, 12.0), 1.0, X, X)
    assert np.abs(on_the_mirror(written(tmp_path, cube)) - WANTED).max() < 8e-3


@pytest.mark.parametrize(
    ("factor", "settings"),
    [
        (5e-7, MapSettings("metre", 0.25, stroke_m=2e-6)),
        (-0.5, MapSettings("micrometre", -0.25, stroke_m=2e-6)),
        (1000.0, MapSettings("nanometre", 0.25, wavefront=True, stroke_m=2e-6)),
        (0.25, MapSettings("stroke", 0.25)),
        (-7.0, MapSettings("peak", -0.1)),
    ],
)
def test_units_sign_and_wavefront(factor: float, settings: MapSettings, tmp_path: Path) -> None:
    assert np.abs(on_the_mirror(written(tmp_path, factor * truth()), settings) - WANTED).max() < 4e-3


def test_a_header_gives_unit_and_coordinates_of_the_pixels(tmp_path: Path) -> None:
    cards = {"BUNIT": "um", "CUNIT1": "mm", "CUNIT2": "mm", "CDELT1": -0.25, "CDELT2": 0.25,
             "CRPIX1": 39.0, "CRPIX2": 39.0}  # fmt: skip
    file = written(tmp_path, 2 * truth()[:, :, ::-1], **cards)
    settings = MapSettings(pitch_m=2e-3, stroke_m=2e-6)
    assert np.abs(on_the_mirror(file, settings) - WANTED).max() < 2e-3
    assert read_maps(file, LAYOUT, settings).sigma == (0.0,) * 5


def test_gaps_offsets_and_the_outside_are_continued(tmp_path: Path) -> None:
    cube = truth() + np.linspace(-0.3, 0.3, len(LAYOUT))[:, None, None]
    cube[:, np.hypot(*np.meshgrid(X, X)) > 3.6] = np.nan
    cube[:, 30:32, 20:24] = np.nan
    found = on_the_mirror(written(tmp_path, cube))
    inside = np.hypot(*np.meshgrid(X[8:-8], X[8:-8])) < 3.4
    assert np.abs(found - WANTED)[:, inside].max() < 0.01
    assert np.isfinite(found).all()
    # Half a pitch beyond the last measured point.
    near = np.hypot(*np.meshgrid(X[8:-8], X[8:-8])) < 4.1
    assert np.abs(found - WANTED)[:, near].max() < 0.25


def test_a_plane_is_continued_and_ends() -> None:
    x = np.arange(60.0)
    plane = np.broadcast_to(0.1 * x, (2, 60, 60)).copy()
    plane[:, :, 20:24] = np.nan
    assert fill_gaps(plane, 8.0) == pytest.approx(np.broadcast_to(0.1 * x, (2, 60, 60)), abs=0.02)
    plane[:, :, 30:] = np.nan
    assert np.abs(fill_gaps(plane, 2.0)[:, :, -1]).max() < 1.5


def test_noise_is_filtered() -> None:
    noise = np.random.default_rng(4).normal(0, 0.01, (len(LAYOUT), X.size, X.size))
    left = filter_noise(truth() + noise) - truth()
    assert left.std() < 0.5 * noise.std()
    # What the maps have on average is kept.
    assert np.abs(filter_noise(truth()) - truth()).max() < 1e-3


def test_fine_maps_are_binned(tmp_path: Path) -> None:
    x = np.arange(-110, 110) / 25
    maps = read_maps(written(tmp_path, truth(x, x)), LAYOUT)
    assert 1 / maps.pixel == pytest.approx(12.5)
    assert np.abs(on_the_mirror(written(tmp_path, truth(x, x))) - WANTED).max() < 5e-3


def test_the_place_has_an_error(tmp_path: Path) -> None:
    scattered = LAYOUT + np.random.default_rng(3).normal(0, 0.02, LAYOUT.shape)
    cube = InfluenceFunctions(scattered, 1.0, 0.4).surfaces(Registration(), 1.0, X, X)
    maps = read_maps(written(tmp_path, cube), LAYOUT)
    # Inner actuators: 21 of 37, with a scatter of 0.02 pitches.
    assert maps.sigma[:2] == pytest.approx([0.02 / np.sqrt(21)] * 2, rel=0.4)
    assert maps.positions == pytest.approx(scattered, abs=0.03)
    assert read_maps(written(tmp_path, cube), LAYOUT, MapSettings(pixel_m=1 / FINE)).sigma[3:] == (0.0, 0.0)


def test_positions_from_a_table_and_from_the_layout(tmp_path: Path) -> None:
    file, table = written(tmp_path, truth()), tmp_path / "positions.txt"
    np.savetxt(table, LAYOUT * FINE + 38)
    assert np.abs(on_the_mirror(file, MapSettings(positions=str(table))) - WANTED).max() < 1e-3
    settings = MapSettings(positions="layout", pixel_m=1 / FINE)
    assert np.abs(on_the_mirror(file, settings) - WANTED).max() < 1e-3
    assert read_maps(file, LAYOUT, settings).positions == pytest.approx(LAYOUT)


@pytest.mark.parametrize(
    ("cube", "settings", "message"),
    [
        (truth()[np.random.default_rng(1).permutation(37)], MapSettings(), "must be numbered as the layout"),
        (truth()[:, 33:44, 33:44], MapSettings(pixel_m=1 / FINE), "of 37 only, too few for their place"),
        (np.where(truth() > 1e-6, truth(), 1e31), MapSettings(), "up to 1e.31, which are no heights"),
        (1e-9 * truth(), MapSettings("nanometre", stroke_m=2e-6), "check devices.dm.influence_unit"),
        (truth(), MapSettings(pixel_m=0.2), "one pixel be 0.2 m"),
        (-truth(), MapSettings(), "reverse the sign of devices.dm.influence_poke"),
        (0 * truth(), MapSettings(), "no values but zero and NaN"),
        (truth()[:5], MapSettings(), r"shape \(5, 77, 77\); influence functions of 37"),
        (truth(), MapSettings(positions="layout"), "needs devices.dm.influence_pixel_m"),
        (truth(), MapSettings(positions="none.txt"), "none.txt"),
        (np.where(np.arange(37)[:, None, None] == 4, np.nan, truth()), MapSettings(), "actuators 4 have no"),
    ],
)
def test_files_that_do_not_fit_are_refused(
    cube: np.ndarray, settings: MapSettings, message: str, tmp_path: Path
) -> None:
    with pytest.raises(ConfigError, match=message):
        read_maps(written(tmp_path, cube), LAYOUT, settings)


def test_numpy_files_and_files_that_are_none(tmp_path: Path) -> None:
    np.save(tmp_path / "maps.npy", truth())
    assert np.array_equal(read_cube(str(tmp_path / "maps.npy"), 37), truth())
    (tmp_path / "text.fits").write_text("no")
    for name in ("none.fits", "text.fits", "none.npy"):
        with pytest.raises(ConfigError, match="cannot be read"):
            read_cube(str(tmp_path / name), 37)


@pytest.mark.parametrize("seen", [2.0, 2.3, 3.0])
def test_a_part_of_the_mirror_is_placed_without_a_bias(seen: float, tmp_path: Path) -> None:
    centre = np.array([0.3, -0.2])
    cube = truth(X + centre[0], X + centre[1])
    cube[:, np.hypot(*np.meshgrid(X, X)) > seen] = np.nan
    maps = read_maps(written(tmp_path, cube), LAYOUT)
    # Peaks that a gap cuts would move the outer actuators inwards, and the scale by per cent.
    assert maps.pixel * FINE == pytest.approx(1.0, abs=2e-4)
    middle = maps.to_mirror(np.array([[0.0, 0.0]]) + maps.centre_px)
    assert middle == pytest.approx(np.zeros((1, 2)), abs=1e-9)
    at = maps.to_pixels(LAYOUT[[18]])[0] - maps.to_pixels(np.zeros((1, 2)))[0]
    assert at == pytest.approx(LAYOUT[18] * FINE, abs=0.01)


def test_numbers_of_maps_that_show_other_actuators_are_named(tmp_path: Path) -> None:
    cube = truth()
    cube[[3, 20]] = cube[[20, 3]]
    with pytest.raises(ConfigError, match=r"maps 3, 20 have their peak far from the actuator"):
        read_maps(written(tmp_path, cube), LAYOUT)
    # An actuator that does not move has no peak.
    cube = truth()
    cube[3] = 1e-3 * np.random.default_rng(2).standard_normal(cube[3].shape)
    assert read_maps(written(tmp_path, cube), LAYOUT).positions[3] == pytest.approx(LAYOUT[3], abs=0.35)


def test_positions_that_are_given_are_compared_with_the_maps(tmp_path: Path) -> None:
    turned = truth()[:, ::-1]
    header = {"CUNIT1": "mm", "CUNIT2": "mm", "CDELT1": 0.25, "CDELT2": 0.25, "CRPIX1": 39.0, "CRPIX2": 39.0}
    with pytest.raises(ConfigError, match="have their peak far from the actuator"):
        read_maps(written(tmp_path, turned, **header), LAYOUT, MapSettings(pitch_m=2e-3))
    settings = MapSettings(positions="layout", pixel_m=1 / FINE)
    with pytest.raises(ConfigError, match="have their peak far from the actuator"):
        read_maps(written(tmp_path, turned), LAYOUT, settings)
    # The piston of a map, which an interferometer does not measure, is no peak.
    assert read_maps(written(tmp_path, truth() - 1.0), LAYOUT, settings).positions == pytest.approx(LAYOUT)
    header |= {"CRPIX1": 1000.0}
    with pytest.raises(ConfigError, match="no actuator has its place on the maps"):
        read_maps(written(tmp_path, truth(), **header), LAYOUT, MapSettings(pitch_m=2e-3))


@pytest.mark.parametrize("seen", [2.6, 6.0])
def test_maps_without_tip_and_tilt_are_refused(seen: float, tmp_path: Path) -> None:
    x, y = np.meshgrid(X, X)
    pupil = np.hypot(x, y) < seen
    plane = np.stack([np.ones(pupil.sum()), x[pupil], y[pupil]], axis=1)
    cube = truth() + np.random.default_rng(1).normal(0, 0.002, (len(LAYOUT), *pupil.shape))
    cube[:, ~pupil] = np.nan
    assert read_maps(written(tmp_path, cube), LAYOUT).pixel * FINE == pytest.approx(1.0, abs=2e-3)
    for surface in cube:
        surface[pupil] -= plane @ np.linalg.lstsq(plane, surface[pupil])[0]
    with pytest.raises(ConfigError, match="the maps have no tilt"):
        read_maps(written(tmp_path, cube), LAYOUT)


def test_unknown_units_archives_and_complex_maps_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"BUNIT is 'waves'; set devices\.dm\.influence_unit"):
        read_maps(written(tmp_path, truth(), BUNIT="waves"), LAYOUT)
    np.savez(tmp_path / "maps.npz", truth())
    with pytest.raises(ConfigError, match="it is an archive; save the maps alone"):
        read_maps(str(tmp_path / "maps.npz"), LAYOUT)
    np.save(tmp_path / "maps.npy", truth() * (1 + 1j))
    with pytest.raises(ConfigError, match="its values are complex"):
        read_maps(str(tmp_path / "maps.npy"), LAYOUT)
