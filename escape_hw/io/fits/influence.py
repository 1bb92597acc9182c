"""Estimated influence functions on disk, in a file that can be the nominal mirror of the next run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits as astropy_fits

from escape_hw.api.influence import MODEL_FITS_CARD, PLACE_CARDS, InfluenceEstimate
from escape_hw.io.fits import extensions as fits_parts
from escape_hw.io.fits import file as fits_file
from escape_hw.io.fits.file import Product
from escape_hw.io.provenance import Provenance

KIND_INFLUENCE = "INFL"
#: Columns of the table of actuators.
_POSITION_COLUMNS = ("X", "Y", "X_SIG", "Y_SIG")


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class InfluenceProduct(Product[InfluenceEstimate]):
    """Estimated influence functions read from disk; lengths are in metres on the mirror."""


def save_influence(
    path: Path | str,
    estimate: InfluenceEstimate,
    system: str,
    simulated: bool,
    magnification: float = 1.0,
    origin: Provenance | None = None,
) -> Path:
    """Write influence functions with errors, positions and profile.

    The maps are the first image, ``INFLUENC (n_act, n_y, n_x)``, with the coordinates of their pixels on the
    mirror in the header, so that ``devices.dm.influence = "file"`` needs no further keys.
    The card ``MODELFIT`` says whether the model of the fit fits, where this was judged.

    Parameters
    ----------
    path, estimate, system, simulated, origin
        File, content, name of the system, whether it is a twin, and provenance.
    magnification
        Length on the mirror per length on the pupil.

    Returns
    -------
    Path
        The file written.

    Raises
    ------
    StorageError
        The file cannot be written; no partial file remains.
    """
    cards: dict[str, Any] = {}
    for axis, coordinates in ((1, estimate.x_m), (2, estimate.y_m)):
        cards |= {
            f"CRPIX{axis}": 1.0, f"CRVAL{axis}": float(coordinates[0]) * magnification,
            f"CDELT{axis}": float(coordinates[1] - coordinates[0]) * magnification, f"CUNIT{axis}": "m",
        }  # fmt: skip
    cards["PITCH"] = estimate.pitch_m * magnification
    place_sigma = estimate.place_sigma * [magnification, magnification, 1, 1, 1]
    cards |= dict(zip(PLACE_CARDS, place_sigma.tolist(), strict=True))
    positions = np.concatenate([estimate.positions_m, estimate.positions_sigma_m], axis=1) * magnification
    columns = dict(zip(_POSITION_COLUMNS, positions.T, strict=True))
    columns |= {"GAIN": estimate.gain, "GAIN_SIG": estimate.gain_sigma, "EDGE": estimate.edge}
    hdus = [
        fits_file.image_extension("INFLUENC", estimate.surfaces.astype(np.float32), "stroke", **cards),
        fits_file.image_extension("INFL_SIG", estimate.sigma.astype(np.float32), "stroke", **cards),
        fits_file.table_extension("POSITIONS", columns),
        fits_parts.pack_profile(estimate.profile),
    ]
    fit_cards = {}
    if estimate.model_fits is not None:
        fit_cards[MODEL_FITS_CARD] = (estimate.model_fits, "F: the model did not fit")
    return fits_file.write_product(
        Path(path), KIND_INFLUENCE, hdus, system, simulated, origin, cards=fit_cards
    )


def load_influence(path: Path | str) -> InfluenceProduct:
    """Read influence functions; lengths of the result are in metres on the mirror.

    Raises
    ------
    ProductError
        Not there, truncated, damaged, of another kind, incomplete or from a newer version.
    """
    return InfluenceProduct.read(path, KIND_INFLUENCE, _unpack)


def _unpack(path: Path, hdus: astropy_fits.HDUList, header: dict[str, Any]) -> InfluenceEstimate:
    surfaces, sigma = (
        fits_file.read_array(path, hdus, name, np.float64) for name in ("INFLUENC", "INFL_SIG")
    )
    cards = hdus["INFLUENC"].header
    x, y = (
        cards[f"CRVAL{axis}"] + cards[f"CDELT{axis}"] * np.arange(n)
        for axis, n in ((1, surfaces.shape[2]), (2, surfaces.shape[1]))
    )
    table = fits_file.require_extension(path, hdus, "POSITIONS").data
    positions = np.stack([np.asarray(table[name], np.float64) for name in _POSITION_COLUMNS], axis=1)
    gain, gain_sigma, edge = (np.asarray(table[name], np.float64) for name in ("GAIN", "GAIN_SIG", "EDGE"))
    profile = fits_parts.unpack_profile(hdus)
    if profile is None:
        raise ValueError("it has no profile")
    return InfluenceEstimate(
        surfaces, sigma, x, y, float(cards["PITCH"]), positions[:, :2], positions[:, 2:], gain, gain_sigma,
        edge > 0, profile, np.array([float(cards[name]) for name in PLACE_CARDS]),
        bool(header[MODEL_FITS_CARD]) if MODEL_FITS_CARD in header else None,
    )  # fmt: skip
