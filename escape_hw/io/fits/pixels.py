"""Dark frames and flats on disk."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np
from astropy.io import fits as astropy_fits
from numpy.typing import NDArray

from escape_hw.io.fits import file as fits_file
from escape_hw.io.fits.file import Product
from escape_hw.io.provenance import Provenance

PixelKind = Literal["DARK", "FLAT"]


def save_pixels(
    path: Path, kind: PixelKind, image: NDArray[np.float32], system: str, simulated: bool, origin: Provenance
) -> Path:
    """Write a dark frame (counts) or a flat (relative response), ``(rows, columns)``; the file written.

    Raises
    ------
    StorageError
        It cannot be written.
    """
    hdus = [fits_file.image_extension(kind, image, "count" if kind == "DARK" else "")]
    return fits_file.write_product(path, kind, hdus, system, simulated, origin)


class PixelsProduct(Product[NDArray[np.float32]]):
    """A dark frame or flat read from disk, ``(rows, columns)``."""


def load_pixels(path: Path | str, kind: PixelKind) -> PixelsProduct:
    """Read a dark frame or flat that :func:`save_pixels` wrote.

    Raises
    ------
    ProductError
        Not there, truncated, damaged, of the other kind, not finite, a flat with a pixel that is not
        positive, or from a newer version.
    """

    def unpack(file: Path, hdus: astropy_fits.HDUList, header: dict[str, Any]) -> NDArray[np.float32]:
        image = fits_file.read_array(file, hdus, kind, np.float32)
        low = 0.0 if kind == "DARK" else float(np.finfo(np.float32).tiny)
        fits_file.require_values(file, kind, image, low, float(np.finfo(np.float32).max))
        return image

    return PixelsProduct.read(path, kind, unpack)
