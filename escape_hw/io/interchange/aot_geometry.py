"""Our sensors' geometry in terms of the telemetry standard AOT, and back.

The standard has the mask, the place of the masks on the detector and the size of a sub-aperture. What our
geometry says beyond that stands as metadata of the mask, which other readers leave alone.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.pyramid import PyramidPupils
from escape_hw.api.sensor import SensorGeometry, SubApertureGrid, of_kind
from escape_hw.errors import IncompatibleProduct


def numbered(valid: NDArray[np.bool_]) -> NDArray[np.int32]:
    """The mask as the standard has it: the number of each valid sub-aperture, -1 elsewhere."""
    mask = np.full(valid.shape, -1, np.int32)
    mask[valid] = np.arange(int(valid.sum()))
    return mask


def order_of(mask: NDArray[np.integer]) -> tuple[NDArray[np.bool_], NDArray[np.intp]]:
    """Valid sub-apertures of a numbered mask, and their numbers row by row, which is our order."""
    valid = np.asarray(mask) >= 0
    return valid, np.asarray(mask)[valid].astype(np.intp)


def facts_of(geometry: SensorGeometry) -> dict[str, float | str]:
    """What the standard has no place for, by keyword."""
    facts: dict[str, float | str] = {"COUNTS": float(geometry.counts), "BACKGND": float(geometry.background)}
    if isinstance(geometry, PyramidPupils):
        facts |= {
            "DIAMETER": float(geometry.diameter_px),
            "MOTION": float(geometry.motion),
            "CENTRESD": float(geometry.centre_sigma_px),
            "NORMAL": geometry.normalisation,
            "MODULAT": float(geometry.modulation),
        }
        for k, (x, y) in enumerate(geometry.centres_px):
            facts |= {f"CENTREX{k}": float(x), f"CENTREY{k}": float(y)}
        return facts
    grid = of_kind(geometry, SubApertureGrid)
    return facts | {
        "ORIGINX": float(grid.origin_px[0]),
        "ORIGINY": float(grid.origin_px[1]),
        "MOTION": float(grid.motion_px),
        "AIR": float(grid.air_px),
    }


def corners_of(geometry: SensorGeometry) -> list[tuple[float, float]]:
    """Lowest (x, y) that each mask occupies on the detector, pixels from its first pixel's edge."""
    if isinstance(geometry, PyramidPupils):
        return [(float(x), float(y)) for x, y in geometry.corners_px]
    grid = of_kind(geometry, SubApertureGrid)
    return [(grid.origin_px[0] - (grid.pitch_px - 1) / 2, grid.origin_px[1] - (grid.pitch_px - 1) / 2)]


def size_of(geometry: SensorGeometry) -> float:
    """Size of a sub-aperture in detector pixels."""
    return 1.0 if isinstance(geometry, PyramidPupils) else float(of_kind(geometry, SubApertureGrid).pitch_px)


def lenslets(
    valid: NDArray[np.bool_],
    references: NDArray[np.float32],
    flux: NDArray[np.float32],
    corners: list[tuple[float, float]],
    size: float,
    facts: dict[str, Any],
) -> SubApertureGrid:
    """A lenslet grid from the standard's parts.

    Parameters
    ----------
    valid, flux
        Mask and relative light ``(n_rows, n_columns)``.
    references
        ``(n_valid, 2)`` as (x, y), pixels.
    corners, size
        As :func:`corners_of` and :func:`size_of` give them.
    facts
        Metadata of the mask; a file that we did not write has none of ours.
    """
    x, y = corners[0] if corners else (0.0, 0.0)
    half = (size - 1) / 2
    return SubApertureGrid(
        pitch_px=size,
        origin_px=(float(facts.get("ORIGINX", x + half)), float(facts.get("ORIGINY", y + half))),
        valid=valid,
        references_px=references,
        flux=flux,
        counts=float(facts.get("COUNTS", 0.0)),
        motion_px=float(facts.get("MOTION", 0.0)),
        air_px=float(facts.get("AIR", 0.0)),
        background=float(facts.get("BACKGND", 0.0)),
    )


def pupils(
    valid: NDArray[np.bool_],
    references: NDArray[np.float32],
    flux: NDArray[np.float32],
    corners: list[tuple[float, float]],
    facts: dict[str, Any],
) -> PyramidPupils:
    """The images of a pyramid from the standard's parts; see :func:`lenslets`.

    Raises
    ------
    IncompatibleProduct
        There are not four masks.
    """
    if len(corners) != 4:
        raise IncompatibleProduct(f"the pyramid has {len(corners)} masks on its detector; ours has four")
    at = np.array(corners, float)
    n = valid.shape[0]
    centres = at + (n - 1) / 2
    for k in range(4):
        centres[k] = (facts.get(f"CENTREX{k}", centres[k, 0]), facts.get(f"CENTREY{k}", centres[k, 1]))
    return PyramidPupils(
        centres_px=centres,
        diameter_px=float(facts.get("DIAMETER") or n),
        corners_px=np.round(at).astype(np.intp),
        valid=valid,
        references=references,
        flux=flux,
        counts=float(facts.get("COUNTS", 0.0)),
        motion=float(facts.get("MOTION", 0.0)),
        background=float(facts.get("BACKGND", 0.0)),
        normalisation=str(facts.get("NORMAL", "global")),
        modulation=float(facts.get("MODULAT", 0.0)),
        centre_sigma_px=float(facts.get("CENTRESD", 0.0)),
    )
