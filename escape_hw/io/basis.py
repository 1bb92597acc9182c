"""Modal bases on disk: one of our own products, or the matrix alone in any FITS file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from astropy.io import fits as astropy_fits
from numpy.typing import NDArray

from escape_hw.errors import ProductError
from escape_hw.io.fits import load_matrix


def load_basis(path: Path | str) -> NDArray[np.float64]:
    """Mode-to-command matrix of a file.

    Parameters
    ----------
    path
        An interaction matrix of ours, checked as such; or any FITS file whose first image with two axes
        is the matrix, actuators along its rows (``NAXIS2``).

    Returns
    -------
    ndarray of float64, ``(n_act, n_modes)``
        As stored; nothing is scaled.

    Raises
    ------
    ProductError
        Not there, damaged, without such an image, or with values that are not finite.
    """
    path = Path(path)
    try:
        with astropy_fits.open(path, memmap=False) as hdus:
            if "KIND" not in hdus[0].header:
                return _plain(path, hdus)
    except OSError as error:
        raise ProductError(f"{path}: cannot be read as FITS ({error})") from error
    return load_matrix(path).matrix.m2c


def _plain(path: Path, hdus: astropy_fits.HDUList) -> NDArray[np.float64]:
    images = (hdu.data for hdu in hdus if hdu.is_image and hdu.data is not None)
    m2c = next((np.asarray(data, np.float64) for data in images if data.ndim == 2), None)
    if m2c is None:
        raise ProductError(f"{path}: holds no image with two axes; a basis is (n_actuators, n_modes)")
    if not np.isfinite(m2c).all():
        raise ProductError(f"{path}: the basis holds values that are not finite")
    return m2c
