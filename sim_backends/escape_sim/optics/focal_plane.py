"""Focal-plane image of the science camera by a matrix Fourier transform."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from escape_sim.optics.shack_hartmann import pupil_field


class FocalPlane:
    """Image of a pupil at any pixel scale.

    Parameters
    ----------
    amplitude, diameter_px
        Pupil amplitude ``(n, n)``, and pupil diameter in samples.
    wavelength_m, psf_px
        Wavelength in metres, and lambda/D in camera pixels.
    shape
        Region (rows, columns); the optical axis is on pixel ``(rows // 2, columns // 2)``.
    """

    def __init__(
        self,
        amplitude: NDArray[np.float32],
        diameter_px: float,
        wavelength_m: float,
        psf_px: float,
        shape: tuple[int, int],
    ) -> None:
        n = amplitude.shape[0]
        samples = (np.arange(n) - (n - 1) / 2) / diameter_px
        power = np.sum(np.square(amplitude, dtype=float))
        self._amplitude = (amplitude / np.sqrt(power)).astype(np.float32).ravel()
        self._per_wave = np.float32(1 / wavelength_m)
        self._field = np.empty((n, n), np.complex64)
        # Parseval: one alias period of the sampled pupil spans diameter_px * psf_px pixels.
        norm = 1 / (diameter_px * psf_px) ** 0.5
        # The minus sign makes a positive slope of the path move the image to higher pixels, as the
        # Shack-Hartmann sensor's spots.
        self._left, self._right = (
            np.asarray(
                np.exp(-2j * np.pi * np.outer(np.arange(m) - m // 2, samples) / psf_px) * norm, np.complex64
            )
            for m in shape
        )

    def image(self, opd_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """Intensity ``(rows, columns)`` that sums to 1 over an infinite camera."""
        opd = np.ascontiguousarray(opd_m, np.float32).ravel()
        pupil_field(opd, self._per_wave, self._amplitude, self._field.view(np.float32).reshape(-1, 2))
        e = self._left @ self._field @ self._right.T
        return np.asarray(e.real**2 + e.imag**2)
