"""Measured influence functions from a file: units, sign, gaps, and where the maps are on the mirror.

The maps are placed by the positions of the actuators on them, unless the header of a FITS file gives the
coordinates of its pixels. So the orientation and the scale of an interferometer's camera need not be known.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse import diags, identity, kron, vstack
from scipy.sparse.linalg import splu

from escape_hw.api.influence import PLACE_CARDS
from escape_hw.array_files import read_array
from escape_hw.bounded_files import MAX_ARRAY_BYTES, read_bounded
from escape_hw.calibration.sprint.influence_shape import find_edge_actuators
from escape_hw.errors import ConfigError, ProductError

#: Metres in the units of heights and of pixels.
_METRES = {
    "m": 1.0, "metre": 1.0, "mm": 1e-3, "um": 1e-6, "micron": 1e-6, "micrometre": 1e-6, "nm": 1e-9,
    "nanometre": 1e-9,
}  # fmt: skip
#: Largest value that can be a height: programs of interferometers mark pixels that are not measured by
#: larger ones. Largest and smallest median peak in full strokes per unit command.
_MAX_VALUE, _MAX_PEAK, _MIN_PEAK = 1e20, 100.0, 0.01
#: Pixels per pitch above twice of which maps are binned.
_PIXELS_PER_PITCH = 12
#: Width in pitches beyond the outermost actuators up to which maps are continued.
_RIM = 2.0
#: Distance in pitches from an actuator beyond which its surface is taken to be flat: the median there is the
#: offset of the map. At least so many pixels are needed.
_FAR, _MIN_FAR_PIXELS = 3.0, 20
#: Radius in pitches of the part of a map whose centroid is the position of its actuator.
_CORE = 0.8
#: Smallest measured share of that part, and largest distance of its measured pixels' mean from its centre as
#: fraction of the radius: a peak at the rim of the maps would seem to be further inside.
_MIN_MEASURED, _MAX_OFF_CENTRE = 0.5, 0.05
#: Fraction of its radius beyond which that part is the surroundings of the peak.
_SURROUNDINGS = 0.85
#: A map whose largest height elsewhere is so many times that at its actuator, and this fraction of the
#: median peak, is one of another actuator.
_ELSEWHERE, _MIN_ELSEWHERE = 2.0, 0.3
#: Radius in pitches of an actuator's own surface, and least tilt of the maps relative to that of the own
#: surfaces: without it the tilt was removed.
_OWN, _MIN_TILT = 1.5, 0.1
#: Noise is filtered where there are so many pixels per pitch; its power is that beyond this fraction of the
#: largest frequency along an axis.
_MIN_FILTERED, _NOISE_BEYOND = 6, 0.9
#: Largest distance in pitches of an actuator from its place in the layout, and smallest share of actuators
#: that must be there. The others are where the layout has them: the peak of an actuator may not be in view.
_MAX_DISTANCE, _MIN_SHARE = 0.35, 0.6
_TRIMMING_ROUNDS = 6
#: Smallest number of inner actuators that suffice for the place, and of any actuators.
_MIN_INNER, _MIN_USED = 9, 4
#: Times that centroids are taken about the place which the last ones gave.
_CENTROID_ROUNDS = 2


class MapSettings(NamedTuple):
    """How the maps were measured: keys ``influence_*`` of ``devices.dm``, its pitch and stroke in metres."""

    unit: str | None = None
    poke: float = 1.0
    wavefront: bool = False
    positions: str = ""
    pixel_m: float | None = None
    pitch_m: float = 1.0
    stroke_m: float = 1.0


class InfluenceMaps(NamedTuple):
    """Maps in fractions of full stroke per unit command, and where they are on the mirror.

    Parameters
    ----------
    surfaces
        ``(n_act, n_y, n_x)``, without gaps.
    pixel
        Distance between pixels in pitches.
    positions
        Positions of the actuators ``(n_act, 2)`` as (x, y) from the centre of the mirror, in pitches.
    centre_px, orientation
        As for :class:`~escape_sim.mirror.measured.MeasuredInfluenceFunctions`.
    sigma
        Standard errors of the place: shifts in pitches, rotation in degrees, scalings in %.
    """

    surfaces: NDArray[np.float64]
    pixel: float
    positions: NDArray[np.float64]
    centre_px: tuple[float, float]
    orientation: NDArray[np.float64]
    sigma: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)

    def to_mirror(self, positions_px: NDArray[np.float64]) -> NDArray[np.float64]:
        """Positions on the mirror in pitches of (column, row) on the maps ``(n, 2)``."""
        return np.asarray((positions_px - self.centre_px) @ self.orientation * self.pixel)

    def to_pixels(self, positions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Inverse of :meth:`to_mirror`."""
        return np.asarray(positions @ self.orientation.T / self.pixel + self.centre_px)


class _File(NamedTuple):
    """Content of a file: maps, and header and table of positions in metres of a FITS file."""

    cube: NDArray[np.float64]
    header: dict[str, Any]
    positions_m: NDArray[np.float64] | None


def read_cube(file: str, n_act: int) -> NDArray[np.float64]:
    """Maps ``(n_act, n_y, n_x)`` of a FITS or NumPy file as they are; gaps are NaN.

    Raises
    ------
    ConfigError
        The file cannot be read, or its data have another shape.
    """
    return _read(file, n_act).cube


def read_maps(file: str, layout: NDArray[np.float64], settings: MapSettings | None = None) -> InfluenceMaps:
    """Read influence functions and place them on the mirror.

    Parameters
    ----------
    file
        FITS or ``.npy`` file with maps ``(n_act, n_y, n_x)``; NaN where nothing was measured.
    layout
        Nominal positions ``(n_act, 2)`` as (x, y) in pitches.
    settings
        How the maps were measured.

    Raises
    ------
    ConfigError
        The file cannot be read, has maps of other actuators, or the maps cannot be placed or scaled.
    """
    settings, content = settings or MapSettings(), _read(file, len(layout))
    cube = content.cube
    empty = np.flatnonzero(~np.isfinite(cube).any(axis=(1, 2)))
    if empty.size:
        raise ConfigError(
            f"{file}: the maps of actuators {', '.join(map(str, empty[:12]))} have no values; give zeros for "
            "actuators that do not move"
        )
    maps = _place(file, content, layout, settings)
    maps = _bin(maps)
    maps = maps._replace(surfaces=_without_offsets(maps))
    _require_own_peaks(file, maps)
    _require_tilt(file, maps)
    surfaces = maps.surfaces * _scale(file, maps, content.header, settings)
    maps = _extend(maps._replace(surfaces=surfaces), layout)
    surfaces = fill_gaps(maps.surfaces, 1 / maps.pixel)
    if maps.pixel * _MIN_FILTERED <= 1:
        surfaces = filter_noise(surfaces)
    return maps._replace(surfaces=surfaces)


def _read(file: str, n_act: int) -> _File:
    path = Path(file).expanduser()
    header: dict[str, Any] = {}
    positions = None
    try:
        if path.suffix == ".npy":
            cube = _real(read_array(path))
        elif path.suffix == ".npz":
            raise ValueError("it is an archive; save the maps alone as .npy or FITS")
        else:
            cube, header, positions = _read_fits(read_bounded(path, MAX_ARRAY_BYTES))
    except (OSError, TypeError, ValueError, KeyError, ProductError) as error:
        raise ConfigError(f"influence functions cannot be read from {path}: {error}") from error
    if cube.ndim != 3 or len(cube) != n_act:
        raise ConfigError(
            f"{path} holds an array of shape {cube.shape}; influence functions of {n_act} actuators "
            f"have the shape ({n_act}, n_y, n_x)"
        )
    cube[np.isinf(cube)] = np.nan
    if not (largest := float(np.nanmax(np.abs(cube), initial=0.0))):
        raise ConfigError(f"{path} has no values but zero and NaN; influence functions are heights")
    if largest > _MAX_VALUE:
        raise ConfigError(
            f"{path} has values up to {largest:.3g}, which are no heights; set the pixels that were not "
            "measured to NaN"
        )
    return _File(cube, header, positions)


def _real(values: NDArray[Any]) -> NDArray[np.float64]:
    if np.iscomplexobj(values):
        raise ValueError("its values are complex; influence functions are real")
    return np.array(values, dtype=float)


def _read_fits(content: bytes) -> tuple[NDArray[np.float64], dict[str, Any], NDArray[np.float64] | None]:
    from astropy.io import fits  # here, so that the synthetic models do not load it

    with fits.open(io.BytesIO(content), memmap=False) as hdus:
        images = [hdu for hdu in hdus if hdu.is_image and hdu.data is not None]
        if not images:
            raise ValueError("it has no image")
        image = next((hdu for hdu in images if hdu.data.ndim == 3), images[0])
        positions = None
        if "POSITIONS" in hdus:
            table = hdus["POSITIONS"].data
            positions = np.stack([np.asarray(table[name], float) for name in ("X", "Y")], axis=1)
        return _real(image.data), dict(image.header), positions


def _place(file: str, content: _File, layout: NDArray[np.float64], settings: MapSettings) -> InfluenceMaps:
    """The maps with their place on the mirror."""
    size = np.array(content.cube.shape[:0:-1])
    middle = (float(size[0] - 1) / 2, float(size[1] - 1) / 2)
    from_header = _header_coordinates(content, settings.pitch_m)
    if from_header is not None and not settings.positions:
        placed = from_header
        if content.positions_m is not None:
            return placed._replace(positions=content.positions_m / settings.pitch_m)
        centroids, _ = _centroids(placed, layout)
        found = placed.to_mirror(centroids)
        return placed._replace(positions=np.where(np.isfinite(found), found, layout))
    if settings.positions == "layout":
        if settings.pixel_m is None:
            raise ConfigError(
                f"{file}: devices.dm.influence_positions = 'layout' needs devices.dm.influence_pixel_m"
            )
        pixel = settings.pixel_m / settings.pitch_m
        return InfluenceMaps(content.cube, pixel, layout, middle, np.eye(2))
    if settings.positions:
        table = _read_table(settings.positions, len(layout))
        return _fit_place(file, content.cube, table, layout, settings, np.ones(len(layout), bool))
    magnitude = ndimage.uniform_filter(np.abs(np.nan_to_num(content.cube)), (0, 3, 3))
    peak = magnitude.reshape(len(layout), -1).argmax(axis=1)
    rows, columns = np.unravel_index(peak, content.cube.shape[1:])
    placed = _fit_place(file, content.cube, np.stack([columns, rows], axis=1).astype(float), layout, settings)
    for _ in range(_CENTROID_ROUNDS):
        centroids, in_view = _centroids(placed, layout)
        placed = _fit_place(file, content.cube, centroids, layout, settings, in_view)
    return placed


def _read_table(file: str, n_act: int) -> NDArray[np.float64]:
    """Positions ``(n_act, 2)`` as (column, row) on the maps."""
    try:
        table = np.asarray(read_array(Path(file).expanduser()), dtype=float)
    except (OSError, ValueError, ProductError) as error:
        raise ConfigError(f"devices.dm.influence_positions: {error}") from error
    if table.shape != (n_act, 2):
        raise ConfigError(
            f"devices.dm.influence_positions: {file} has shape {table.shape}; it needs column and row of "
            f"the {n_act} actuators on the maps, ({n_act}, 2)"
        )
    return table


def _header_coordinates(content: _File, pitch_m: float) -> InfluenceMaps | None:
    """Place from the cards CRPIX, CRVAL, CDELT and CUNIT of a FITS file; ``None`` without them."""
    header = content.header
    if any(f"{card}{axis}" not in header for card in ("CRPIX", "CDELT") for axis in (1, 2)):
        return None
    unit = [_METRES.get(str(header.get(f"CUNIT{axis}", "")).strip()) for axis in (1, 2)]
    if None in unit:
        return None
    step = np.array([float(header[f"CDELT{axis}"]) * (unit[axis - 1] or 0) for axis in (1, 2)])
    if not np.isclose(abs(step[0]), abs(step[1]), rtol=1e-6) or not step.all():
        return None
    value = np.array([float(header.get(f"CRVAL{axis}", 0.0)) * (unit[axis - 1] or 0) for axis in (1, 2)])
    centre = np.array([float(header[f"CRPIX{axis}"]) - 1 for axis in (1, 2)]) - value / step
    return InfluenceMaps(
        content.cube, float(abs(step[0])) / pitch_m, np.zeros((len(content.cube), 2)),
        (float(centre[0]), float(centre[1])), np.diag(np.sign(step)), _header_sigma(header, pitch_m),
    )  # fmt: skip


def _header_sigma(header: dict[str, Any], pitch_m: float) -> tuple[float, float, float, float, float]:
    """Errors of the place that SPRINT states for functions that it has found; 0 for others."""
    x, y, *others = (float(header.get(card, 0.0)) for card in PLACE_CARDS)
    return x / pitch_m, y / pitch_m, others[0], others[1], others[2]


def _fit_place(
    file: str, cube: NDArray[np.float64], at_px: NDArray[np.float64], layout: NDArray[np.float64],
    settings: MapSettings, in_view: NDArray[np.bool_] | None = None,
) -> InfluenceMaps:  # fmt: skip
    """Shift, rotation, reflection and scale from the layout to positions on the maps (Procrustes).

    Positions are NaN where they are not known. Edge actuators are left out if the others suffice, because
    their peaks are displaced; actuators far from their place are left out, in several rounds. With
    ``in_view``, the actuators that the maps show, most of those must be at their place.
    """
    known = np.asarray(np.isfinite(at_px).all(axis=1))
    if in_view is not None and in_view.sum() < _MIN_USED:
        raise ConfigError(
            f"{file}: the maps show the whole peak of {int(in_view.sum())} actuators of {len(layout)} only, "
            "too few for their place; give pixel coordinates in a FITS header, or "
            "devices.dm.influence_positions"
        )
    if in_view is not None and known.sum() < _MIN_USED:
        raise _misplaced(file, known, in_view, settings)
    inner = ~find_edge_actuators(layout) & known
    if inner.sum() < _MIN_INNER:
        inner = known
    used, distance = inner, np.zeros(len(layout))
    for _ in range(_TRIMMING_ROUNDS):
        p, q = layout[used].mean(axis=0), at_px[used].mean(axis=0)
        u, singular, vt = np.linalg.svd((at_px[used] - q).T @ (layout[used] - p))
        orientation = u @ vt
        scale = float(singular.sum() / max(np.square(layout[used] - p).sum(), 1e-300))
        if settings.pixel_m is not None:
            scale = settings.pitch_m / settings.pixel_m
        centre = q - scale * orientation @ p
        away = at_px - scale * layout @ orientation.T - centre
        distance = np.linalg.norm(away, axis=1) / max(scale, 1e-300)
        used = inner & (distance <= max(_MAX_DISTANCE, float(np.median(distance[inner]))))
    near = distance <= _MAX_DISTANCE
    if in_view is not None and near[in_view].mean() < _MIN_SHARE:
        raise _misplaced(file, near & in_view, in_view, settings)
    placed = InfluenceMaps(
        cube, 1 / scale, layout, (float(centre[0]), float(centre[1])), orientation,
        _place_sigma(layout[used], distance[used], settings.pixel_m is None),
    )  # fmt: skip
    return placed._replace(positions=np.where(near[:, None], placed.to_mirror(at_px), layout))


def _misplaced(
    file: str, near: NDArray[np.bool_], in_view: NDArray[np.bool_], settings: MapSettings
) -> ConfigError:
    """The error of maps of which too few have their actuator at its place."""
    return ConfigError(
        f"{file}: only {int(near.sum())} of the {int(in_view.sum())} actuators in view are where "
        "devices.dm.layout has them; the maps must be numbered as the layout"
        + ("" if settings.pixel_m is None else f", and one pixel be {settings.pixel_m:g} m on the mirror")
    )


def _place_sigma(
    layout: NDArray[np.float64], distance: NDArray[np.float64], scaled: bool
) -> tuple[float, float, float, float, float]:
    """Standard errors of the place from the distances of the actuators, in pitches, from theirs."""
    n = len(layout)
    scatter = float(np.sqrt(np.square(distance).sum() / max(2 * n - 4, 1)))
    x, y = np.sqrt(np.square(layout - layout.mean(axis=0)).sum(axis=0))
    shift, scaling = scatter / np.sqrt(n), 100 * scatter * scaled
    return shift, shift, float(np.rad2deg(scatter / np.hypot(x, y))), scaling / float(x), scaling / float(y)


def _cores(
    maps: InfluenceMaps, positions: NDArray[np.float64]
) -> Iterator[tuple[NDArray[np.intp], NDArray[np.float64]]]:
    """For every actuator, pixels ``(n, 2)`` within :data:`_CORE` of its position and their heights.

    Pixels beyond the maps have the height NaN.
    """
    radius = _CORE / maps.pixel
    size = np.array(maps.surfaces.shape[:0:-1])
    for surface, at in zip(maps.surfaces, maps.to_pixels(positions), strict=True):
        left, top = np.floor(at - radius).astype(int)
        right, bottom = np.ceil(at + radius).astype(int) + 1
        columns, rows = np.meshgrid(np.arange(left, right), np.arange(top, bottom))
        pixels = np.stack([columns.ravel(), rows.ravel()], axis=1)
        pixels = pixels[np.linalg.norm(pixels - at, axis=1) <= radius]
        heights = np.full(len(pixels), np.nan)
        on_maps = ((pixels >= 0) & (pixels < size)).all(axis=1)
        heights[on_maps] = surface[pixels[on_maps, 1], pixels[on_maps, 0]]
        yield pixels, heights


def _centroids(
    maps: InfluenceMaps, layout: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Centroids of the peaks as (column, row) ``(n, 2)``, and which peaks are in view.

    They are those of the upper half, or of what is above the surroundings if that is less. NaN without a
    clear peak near the place in the layout, or where it is not all in view.
    """
    found, in_view = np.full(layout.shape, np.nan), np.zeros(len(layout), bool)
    expected = maps.to_pixels(layout)
    for number, (pixels, heights) in enumerate(_cores(maps, layout)):
        measured = np.isfinite(heights)
        if measured.mean() < _MIN_MEASURED:
            continue
        off_centre = np.linalg.norm(pixels[measured].mean(axis=0) - pixels.mean(axis=0))
        if off_centre * maps.pixel > _MAX_OFF_CENTRE * _CORE:
            continue
        in_view[number] = True
        pixels, heights = pixels[measured], np.abs(heights[measured])
        distance = np.linalg.norm(pixels - expected[number], axis=1) * maps.pixel
        around = heights[distance > _SURROUNDINGS * _CORE].max(initial=0.0)
        weight = np.maximum(heights - max(heights.max() / 2, around), 0.0)
        if not weight.sum() > 0:
            continue
        centroid = weight @ pixels / weight.sum()
        if np.linalg.norm(centroid - expected[number]) * maps.pixel < _MAX_DISTANCE:
            found[number] = centroid
    return found, in_view


def _require_own_peaks(file: str, maps: InfluenceMaps) -> None:
    """Refuse maps that show the peaks of other actuators than their numbers say."""
    smooth = ndimage.uniform_filter(np.abs(np.nan_to_num(maps.surfaces)), (0, 3, 3))
    at_place, elsewhere = np.zeros(len(smooth)), np.zeros(len(smooth))
    in_view = np.zeros(len(smooth), bool)
    smoothed = maps._replace(surfaces=np.where(np.isfinite(maps.surfaces), smooth, np.nan))
    for number, (pixels, heights) in enumerate(_cores(smoothed, maps.positions)):
        measured = np.isfinite(heights)
        if measured.mean() < _MIN_MEASURED:
            continue
        in_view[number] = True
        at_place[number] = heights[measured].max()
        others = smooth[number].copy()
        others[pixels[measured, 1], pixels[measured, 0]] = 0.0
        elsewhere[number] = others.max()
    if not in_view.any():
        raise ConfigError(
            f"{file}: no actuator has its place on the maps; check the pixel coordinates in the header "
            "(CRPIX, CRVAL, CDELT, CUNIT) or devices.dm.influence_positions and influence_pixel_m"
        )
    least = _MIN_ELSEWHERE * float(np.median(np.maximum(at_place, elsewhere)[in_view]))
    wrong = np.flatnonzero(in_view & (elsewhere > np.maximum(_ELSEWHERE * at_place, least)))
    if wrong.size:
        raise ConfigError(
            f"{file}: maps {', '.join(map(str, wrong[:12]))}{', ...' if wrong.size > 12 else ''} have their "
            "peak far from the actuator of that number; number and orient the maps as devices.dm.layout, and "
            "set pixels that were not measured to NaN"
        )


def _require_tilt(file: str, maps: InfluenceMaps) -> None:
    """Refuse maps whose tip and tilt were removed: no mirror has such functions.

    An actuator beside the centre tilts the best-fitting plane as its own surface alone does, more or less.
    """
    rows, columns = np.indices(maps.surfaces.shape[1:])
    at = maps.to_mirror(np.stack([columns.ravel(), rows.ravel()], axis=1))
    plane = np.column_stack([np.ones(len(at)), at])
    product = power = 0.0
    for surface, position in zip(maps.surfaces.reshape(len(maps.surfaces), -1), maps.positions, strict=True):
        measured = np.isfinite(surface)
        near = np.linalg.norm(at - position, axis=1) < _OWN
        own = np.where(near, surface, 0.0)
        both = np.stack([surface[measured], own[measured]], axis=1)
        tilt, own_tilt = np.linalg.lstsq(plane[measured], both)[0][1:].T
        product, power = product + float(tilt @ own_tilt), power + float(own_tilt @ own_tilt)
    if abs(product) < _MIN_TILT * power:
        raise ConfigError(
            f"{file}: the maps have no tilt, as if tip and tilt had been removed from each; put them back, "
            "or measure the maps without removing them"
        )


def _bin(maps: InfluenceMaps) -> InfluenceMaps:
    """Means of square blocks where the pixels are much smaller than needed."""
    k = int(1 / maps.pixel / _PIXELS_PER_PITCH)
    if k < 2:
        return maps
    n, height, width = maps.surfaces.shape
    blocks = maps.surfaces[:, : height // k * k, : width // k * k].reshape(n, height // k, k, width // k, k)
    valid = np.isfinite(blocks)
    count = valid.sum(axis=(2, 4))
    total = np.where(valid, blocks, 0.0).sum(axis=(2, 4))
    means = np.where(2 * count >= k * k, total / np.maximum(count, 1), np.nan)
    column, row = ((c - (k - 1) / 2) / k for c in maps.centre_px)
    return maps._replace(surfaces=means, pixel=maps.pixel * k, centre_px=(column, row))


def _without_offsets(maps: InfluenceMaps) -> NDArray[np.float64]:
    """The maps without their median height far from the actuator: an interferometer measures no piston."""
    rows, columns = np.indices(maps.surfaces.shape[1:])
    at = maps.to_mirror(np.stack([columns.ravel(), rows.ravel()], axis=1))
    out = maps.surfaces.copy()
    for surface, position in zip(out, maps.positions, strict=True):
        far = surface.ravel()[np.linalg.norm(at - position, axis=1) > _FAR]
        far = far[np.isfinite(far)]
        if far.size >= _MIN_FAR_PIXELS:
            surface -= np.median(far)
    return out


def _scale(file: str, maps: InfluenceMaps, header: dict[str, Any], settings: MapSettings) -> float:
    """Factor from the file's values to fractions of full stroke per unit command."""
    unit = settings.unit or str(header.get("BUNIT", "")).strip()
    rows, columns = np.indices(maps.surfaces.shape[1:])
    pixels = np.stack([columns.ravel(), rows.ravel()], axis=1)
    heights = []
    for surface, expected in zip(maps.surfaces, maps.to_pixels(maps.positions), strict=True):
        core = surface.ravel()[np.linalg.norm(pixels - expected, axis=1) < _CORE / maps.pixel / 2]
        core = core[np.isfinite(core)]
        if core.size:
            heights.append(core[np.abs(core).argmax()])
    if unit not in (*_METRES, "stroke", "peak", ""):
        raise ConfigError(
            f"{file}: BUNIT is {unit!r}; set devices.dm.influence_unit to metre, micrometre, nanometre, "
            "stroke or peak"
        )
    peak = float(np.median(heights)) * np.sign(settings.poke)
    if not peak > 0:
        raise ConfigError(
            f"{file}: the median peak is {peak:g}: "
            + ("the maps are zero" if peak == 0 else "reverse the sign of devices.dm.influence_poke")
        )
    if unit in _METRES:
        factor = _METRES[unit] / (settings.poke * settings.stroke_m)
    elif unit == "stroke":
        factor = 1 / settings.poke
    else:
        return float(np.sign(settings.poke) / peak)
    factor = factor / 2 if settings.wavefront else factor
    if not _MIN_PEAK < peak * abs(factor) < _MAX_PEAK:
        raise ConfigError(
            f"{file}: the median peak is {peak * abs(factor):.2g} full strokes for a command of full stroke; "
            "check devices.dm.influence_unit, influence_poke and stroke_m"
        )
    return factor


def _extend(maps: InfluenceMaps, layout: NDArray[np.float64]) -> InfluenceMaps:
    """The maps with a margin of gaps where they do not reach beyond the mirror."""
    corners = maps.to_pixels(layout)
    rim = _RIM / maps.pixel
    height, width = maps.surfaces.shape[1:]
    left, top = np.maximum(np.ceil(rim - corners.min(axis=0)), 0).astype(int)
    right, bottom = np.maximum(np.ceil(corners.max(axis=0) + rim - (width - 1, height - 1)), 0).astype(int)
    surfaces = np.pad(
        maps.surfaces, ((0, 0), (int(top), int(bottom)), (int(left), int(right))), constant_values=np.nan
    )
    column, row = maps.centre_px
    return maps._replace(surfaces=surfaces, centre_px=(column + float(left), row + float(top)))


def fill_gaps(surfaces: NDArray[np.float64], length_px: float) -> NDArray[np.float64]:
    """Surfaces ``(n, n_y, n_x)`` continued smoothly where they are NaN.

    A plate under tension, ``length_px`` pixels long where bending and tension are equal, and held at zero
    with a hundredth of it: within a gap the curvature is least, far beyond an edge the surface is flat and
    then zero.
    """
    gap = ~np.isfinite(surfaces)
    if not gap.any():
        return surfaces
    stiffness = _tension_stiffness(surfaces.shape[1:], length_px)
    out = np.where(gap, 0.0, surfaces)
    masks, group = np.unique(gap.reshape(len(gap), -1), axis=0, return_inverse=True)
    for number, mask in enumerate(masks):
        if not mask.any():
            continue
        members = np.flatnonzero(group.ravel() == number)
        known = out[members].reshape(len(members), -1)
        load = -(stiffness[mask] @ known.T)
        known[:, mask] = splu(stiffness[mask][:, mask].tocsc()).solve(load).T
        out[members] = known.reshape(-1, *gap.shape[1:])
    return out


def filter_noise(surfaces: NDArray[np.float64]) -> NDArray[np.float64]:
    """Surfaces ``(n, n_y, n_x)`` without what is noise on average over all of them (Wiener filter).

    Noise of the maps would be noise of the derivatives, which biases a fit with them. Its power, taken to be
    that at the largest frequencies, is compared with the mean power at each frequency.
    """
    size = 2 * np.array(surfaces.shape[1:])
    frequency = np.stack(np.meshgrid(np.fft.rfftfreq(size[1]), np.fft.fftfreq(size[0])))
    # Continued by reflection, a map has no edges.
    reflected = np.concatenate([surfaces, surfaces[:, ::-1]], axis=1)
    transforms = np.fft.rfft2(np.concatenate([reflected, reflected[:, :, ::-1]], axis=2))
    power = np.mean(np.square(np.abs(transforms)), axis=0)
    ring = np.minimum((np.hypot(*frequency) * size.max()).astype(int), int(size.max()) // 2)
    by_ring = np.bincount(ring.ravel(), power.ravel()) / np.maximum(np.bincount(ring.ravel()), 1)
    noise = float(np.median(power[np.abs(frequency).max(axis=0) > _NOISE_BEYOND / 2]))
    kept = np.clip(1 - noise / np.maximum(by_ring, 1e-300), 0.0, 1.0)
    filtered = np.fft.irfft2(transforms * kept[ring], tuple(size))
    return np.asarray(filtered[:, : surfaces.shape[1], : surfaces.shape[2]])


def _tension_stiffness(shape: tuple[int, ...], length_px: float) -> Any:
    """Matrix of the energy of a plate under tension, over the pixels in row-major order."""

    def differences(n: int, order: int) -> Any:
        weights = {1: (-1.0, 1.0), 2: (1.0, -2.0, 1.0)}[order]
        return diags(weights, range(order + 1), shape=(max(n - order, 0), n))

    (rows, columns), (unit_y, unit_x) = shape, (identity(n) for n in shape)
    along_x, along_y = (kron(unit_y, differences(columns, 1)), kron(differences(rows, 1), unit_x))
    bending = vstack([
        kron(unit_y, differences(columns, 2)), kron(differences(rows, 2), unit_x),
        np.sqrt(2) * kron(differences(rows, 1), differences(columns, 1)),
    ])  # fmt: skip
    tension = vstack([along_x, along_y])
    foundation = 1e-2 / length_px**2 * identity(rows * columns)
    return (length_px**2 * bending.T @ bending + tension.T @ tension + foundation).tocsr()
