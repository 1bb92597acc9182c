"""The geometry of a sensor as FITS extensions, and back; one pair of functions for each kind."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from escape_hw.api.pyramid import PyramidPupils
from escape_hw.api.sensor import SensorGeometry, SubApertureGrid, of_kind
from escape_hw.errors import ProductError
from escape_hw.io import fits_file

_PUPILS = "PUPILS"


def pack_grid(grid: SensorGeometry) -> list[Any]:
    """The references with all numbers of the geometry as cards, and the flux map.

    The card SENSOR names the kind; the mask stands in VALID.
    """
    pack, _ = _KINDS[grid.kind]
    references, cards, more = pack(grid)
    cards |= {"COUNTS": float(grid.counts), "BACKGND": float(grid.background), "SENSOR": grid.kind}
    return [
        fits_file.image("GRID", np.asarray(references, np.float32), grid.slope_unit, **cards),
        fits_file.image("FLUX", np.asarray(grid.flux, np.float32)),
        *more,
    ]


def unpack_grid(path: Path, hdus: fits.HDUList) -> SensorGeometry:
    """Inverse of :func:`pack_grid`, with the mask from VALID.

    Raises
    ------
    ProductError
        Parts are missing, do not fit each other, or belong to a kind of sensor that is not known.
    """
    header = fits_file.need(path, hdus, "GRID").header
    valid = fits_file.array(path, hdus, "VALID", np.uint8).astype(bool)
    references = fits_file.array(path, hdus, "GRID", np.float32)
    if references.shape != (int(valid.sum()), 2):
        raise ProductError(f"{path}: GRID has shape {references.shape}, VALID marks {int(valid.sum())}")
    # Products from before there was a second kind do not say theirs.
    kind = str(header.get("SENSOR", SubApertureGrid.kind))
    if kind not in _KINDS:
        raise ProductError(f"{path}: its sensor is of kind '{kind}'; this version knows {', '.join(_KINDS)}")
    _, unpack = _KINDS[kind]
    common = {
        "valid": valid,
        "flux": fits_file.array(path, hdus, "FLUX", np.float32),
        "counts": float(header["COUNTS"]),
        "background": float(header["BACKGND"]),
    }
    return unpack(path, hdus, references, common)


_Packed = tuple[NDArray[np.float32], dict[str, Any], list[Any]]


def _pack_lenslets(geometry: SensorGeometry) -> _Packed:
    grid = of_kind(geometry, SubApertureGrid)
    cards = {
        "PITCH": float(grid.pitch_px),
        "ORIGINX": float(grid.origin_px[0]),
        "ORIGINY": float(grid.origin_px[1]),
        "MOTION": float(grid.motion_px),
        "AIR": float(grid.air_px),
    }
    return grid.references_px, cards, []


def _unpack_lenslets(
    path: Path, hdus: fits.HDUList, references: NDArray[np.float32], common: dict[str, Any]
) -> SubApertureGrid:
    header = fits_file.need(path, hdus, "GRID").header
    return SubApertureGrid(
        pitch_px=float(header["PITCH"]),
        origin_px=(float(header["ORIGINX"]), float(header["ORIGINY"])),
        references_px=references,
        motion_px=float(header["MOTION"]),
        # Products of earlier versions have none.
        air_px=float(header.get("AIR", 0.0)),
        **common,
    )


def _pack_pupils(geometry: SensorGeometry) -> _Packed:
    pupils = of_kind(geometry, PyramidPupils)
    cards = {
        "DIAMETER": float(pupils.diameter_px),
        "MOTION": float(pupils.motion),
        "CENTRESD": float(pupils.centre_sigma_px),
        "POKES": float(pupils.pokes),
        "LOOKS": float(pupils.looks),
        "STEADY": float(pupils.steady),
        "NORMAL": fits_file.plain(pupils.normalisation),
        "MODULAT": float(pupils.modulation),
    }
    places = {
        "X": np.asarray(pupils.centres_px[:, 0], np.float64),
        "Y": np.asarray(pupils.centres_px[:, 1], np.float64),
        "CORNERX": np.asarray(pupils.corners_px[:, 0], np.int64),
        "CORNERY": np.asarray(pupils.corners_px[:, 1], np.int64),
    }
    return pupils.references, cards, [fits_file.table(_PUPILS, places)]


def _unpack_pupils(
    path: Path, hdus: fits.HDUList, references: NDArray[np.float32], common: dict[str, Any]
) -> PyramidPupils:
    header, table = fits_file.need(path, hdus, "GRID").header, fits_file.need(path, hdus, _PUPILS).data
    if len(table) != 4:
        raise ProductError(f"{path}: {_PUPILS} has {len(table)} rows; a pyramid makes four images")
    return PyramidPupils(
        centres_px=np.stack([table["X"], table["Y"]], axis=1).astype(np.float64),
        diameter_px=float(header["DIAMETER"]),
        corners_px=np.stack([table["CORNERX"], table["CORNERY"]], axis=1).astype(np.intp),
        references=references,
        motion=float(header["MOTION"]),
        centre_sigma_px=float(header["CENTRESD"]),
        # Products written before these were recorded do without.
        pokes=float(header.get("POKES", 0.0)),
        looks=float(header.get("LOOKS", 0.0)),
        steady=float(header.get("STEADY", 0.0)),
        normalisation=str(header["NORMAL"]),
        modulation=float(header["MODULAT"]),
        **common,
    )


_KINDS: dict[str, tuple[Callable[[SensorGeometry], _Packed], Callable[..., SensorGeometry]]] = {
    SubApertureGrid.kind: (_pack_lenslets, _unpack_lenslets),
    PyramidPupils.kind: (_pack_pupils, _unpack_pupils),
}
