"""Offsets on disk."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from astropy.io import fits as astropy_fits

from escape_hw.api.offsets import Offsets
from escape_hw.errors import IncompatibleProduct
from escape_hw.io import documents
from escape_hw.io.fits import file as fits_file
from escape_hw.io.fits.file import Product
from escape_hw.io.provenance import Provenance

KIND_OFFSETS = "OFFSETS"
_ARRAYS = {"modes": "float64", "slopes": "float32", "flat": "float64"}


def save_offsets(path: Path, offsets: Offsets, system: str, simulated: bool, origin: Provenance) -> Path:
    """Write offsets; returns the file written (StorageError: it cannot be written)."""
    arrays = [(name.upper(), getattr(offsets, name)) for name in _ARRAYS]
    hdus = [
        fits_file.text_extension("TERMS", documents.dumps(dict(offsets.terms))),
        *(fits_file.image_extension(name, data) for name, data in arrays if data.size),
    ]
    return fits_file.write_product(path, KIND_OFFSETS, hdus, system, simulated, origin)


class OffsetsProduct(Product[Offsets]):
    """Offsets read from disk."""


def load_offsets(
    path: Path | str, expect_system: str | None = None, allow_simulated: bool = True
) -> OffsetsProduct:
    """Read offsets that :func:`save_offsets` wrote.

    Parameters
    ----------
    expect_system
        Name of the system they must belong to.
    allow_simulated
        False on hardware: simulated offsets are refused.

    Raises
    ------
    ProductError
        Not there, truncated, damaged, of another kind, incomplete or from a newer version.
    IncompatibleProduct
        Sound, but of another system, or simulated.
    """
    product = OffsetsProduct.read(path, KIND_OFFSETS, _unpack)
    wanted = None if expect_system is None else fits_file.header_text(expect_system)
    fits_file.expect(product.path, "system", product.header.get("SYSTEM"), wanted)
    if product.header.get("SIMULATE", True) and not allow_simulated:
        raise IncompatibleProduct(f"{path}: made in simulation; it is not for hardware")
    return product


def _unpack(path: Path, hdus: astropy_fits.HDUList, header: dict[str, Any]) -> Offsets:
    terms = json.loads(fits_file.read_text(path, hdus, "TERMS"))
    present = {hdu.name for hdu in hdus}
    arrays = {
        name: fits_file.read_array(path, hdus, name.upper(), dtype)
        for name, dtype in _ARRAYS.items()
        if name.upper() in present
    }
    return Offsets({str(name): float(value) for name, value in terms.items()}, **arrays)
