"""Closed-loop runs on disk: stacked PSF, model PSF, Strehl ratios, residual record."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits as astropy_fits

from escape_hw.api.results import Estimate, LoopResult, StrehlEstimate
from escape_hw.io.fits import extensions as fits_parts
from escape_hw.io.fits import file as fits_file
from escape_hw.io.fits.file import Product
from escape_hw.io.provenance import Provenance

KIND_PSF = "PSF"
_STREHL_METHODS = ("peak", "otf", "encircled")
#: Scalars of the extension RUN.
_SCALARS = {
    "gain": float, "leak": float, "dropped_modes": int, "frames": int, "lost_frames": int, "rate_hz": float,
    "residual_rms_nm": float,
}  # fmt: skip
_IMAGES = {
    "psf": ("PSF", np.float32, "count"),
    "model_psf": ("MODEL", np.float32, "count"),
    "residual_nm": ("RESIDUAL", np.float32, "nm"),
    "last_command": ("COMMAND", np.float64, ""),
    "last_frame": ("FRAME", np.uint16, "count"),
}


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class LoopProduct(Product[LoopResult]):
    """A closed-loop run read from disk."""


def save_loop(
    path: Path, result: LoopResult, system: str, simulated: bool, origin: Provenance | None = None
) -> Path:
    """Write a closed-loop run; an aborted one as ``*.partial.fits``.

    Returns
    -------
    Path
        The file written.

    Raises
    ------
    StorageError
        The file cannot be written; no partial file remains.
    """
    run = {name: getattr(result, name) for name in (*_SCALARS, "gain_sigma")}
    run |= {"latency_us": dict(result.latency_us), "notes": list(result.notes)}
    hdus = [fits_parts.pack_metrics(run, "RUN")]
    for name, (extension, dtype, unit) in _IMAGES.items():
        data = getattr(result, name)
        if data is not None and data.size:
            hdus.append(fits_file.image_extension(extension, np.asarray(data, dtype), unit))
    if result.strehl is not None:
        rows = [getattr(result.strehl, method) for method in _STREHL_METHODS]
        columns = {
            "NAME": np.array(_STREHL_METHODS),
            "VALUE": np.array([row.value for row in rows], float),
            "SIGMA": np.array([row.sigma for row in rows], float),
        }
        hdus.append(fits_file.table_extension("STREHL", columns))
    cards = {
        "METHOD": (result.method, "the matrix that closed the loop"),
        "STABLE": (bool(result.stable), "the loop stayed stable"),
    }
    return fits_file.write_product(
        path, KIND_PSF, hdus, system, simulated, origin, partial=result.partial, cards=cards
    )


def load_loop(path: Path | str) -> LoopProduct:
    """Read a closed-loop run.

    Raises
    ------
    ProductError
        Not there, truncated, damaged, of another kind, incomplete or from a newer version.
    """
    return LoopProduct.read(path, KIND_PSF, _unpack)


def _unpack(path: Path, hdus: astropy_fits.HDUList, header: dict[str, Any]) -> LoopResult:
    run = fits_parts.unpack_metrics(path, hdus, "RUN")
    fields: dict[str, Any] = {name: kind(run[name]) for name, kind in _SCALARS.items()}
    fields |= {
        name: fits_file.read_array(path, hdus, extension, dtype)
        for name, (extension, dtype, _unit) in _IMAGES.items()
        if extension in hdus
    }
    strehl = None
    if "STREHL" in hdus:
        data = hdus["STREHL"].data
        values = zip(data["VALUE"], data["SIGMA"], strict=True)
        strehl = StrehlEstimate(*(Estimate(float(value), float(sigma)) for value, sigma in values))
    return LoopResult(
        method=str(header["METHOD"]),
        stable=bool(header["STABLE"]),
        strehl=strehl,
        latency_us={str(name): float(value) for name, value in run["latency_us"].items()},
        partial=header["FINISH"] == "aborted",
        notes=tuple(str(note) for note in run["notes"]),
        gain_sigma=run.get("gain_sigma"),
        **fields,
    )
