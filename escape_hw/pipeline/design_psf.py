"""The image that the design's pupil would make in still air."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def design_psf(
    pupil: NDArray[np.bool_], samples_across: float, psf_px: float, shape: tuple[int, int]
) -> NDArray[np.float32]:
    """Diffraction image of a pupil, by a matrix Fourier transform (Soummer et al. 2007).

    Parameters
    ----------
    pupil
        Where light passes ``(n, n)``.
    samples_across
        Samples across the diameter D of the pupil.
    psf_px
        lambda/D in camera pixels.
    shape
        Camera region (rows, columns).

    Returns
    -------
    ndarray of float32, ``(rows, columns)``
        Sums to one over an infinite camera; its peak lies on the middle pixel.
    """
    n = pupil.shape[0]
    places = (np.arange(n) - (n - 1) / 2) / samples_across
    left, right = (np.exp(-2j * np.pi * np.outer(np.arange(m) - m // 2, places) / psf_px) for m in shape)
    field = left @ pupil.astype(float) @ right.T
    power = pupil.sum() * (samples_across * psf_px) ** 2
    return np.asarray(np.abs(field) ** 2 / power, dtype=np.float32)
