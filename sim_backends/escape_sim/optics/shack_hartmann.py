"""Diffractive Shack-Hartmann optics: one matrix Fourier transform per lenslet."""

from __future__ import annotations

import abc
import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from escape_sim.optics.base import SensorOptics

# Taylor coefficients of sin(x) and cos(x) for |x| <= pi/2; the error of 6e-8 is that of float32.
_S3, _S5, _S7, _S9, _S11 = (-1 / 6, 1 / 120, -1 / 5040, 1 / 362880, -1 / 39916800)
_C2, _C4, _C6, _C8, _C10, _C12 = (-1 / 2, 1 / 24, -1 / 720, 1 / 40320, -1 / 3628800, 1 / 479001600)
_F = np.float32


@njit(cache=True, fastmath=True, nogil=True)
def pupil_field(opd, per_wave, amplitude, field):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Complex field ``amplitude exp(2 i pi opd per_wave)``; fills ``field (n, 2)`` (real, imaginary)."""
    for k in range(opd.size):
        turn = opd[k] * per_wave
        turn -= np.rint(turn)
        x = turn * _F(math.pi)
        x2 = x * x
        s = x * (_F(1) + x2 * (_F(_S3) + x2 * (_F(_S5) + x2 * (_F(_S7) + x2 * (_F(_S9) + x2 * _F(_S11))))))
        c = _F(1) + x2 * (
            _F(_C2) + x2 * (_F(_C4) + x2 * (_F(_C6) + x2 * (_F(_C8) + x2 * (_F(_C10) + x2 * _F(_C12)))))
        )
        field[k, 0] = amplitude[k] * (_F(1) - _F(2) * s * s)
        field[k, 1] = amplitude[k] * (_F(2) * s * c)


@njit(cache=True, fastmath=True, nogil=True)
def _add_intensities(spots, lit, y0, x0, image):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add the intensity of ``spots (rows, field, columns, field, 2)`` to the image."""
    f = spots.shape[1]
    for i in range(spots.shape[0]):
        for v in range(f):
            row = y0[i] + v
            for j in range(spots.shape[2]):
                if lit[i, j]:
                    left = x0[j]
                    for u in range(f):
                        re = spots[i, v, j, u, 0]
                        im = spots[i, v, j, u, 1]
                        image[row, left + u] += re * re + im * im


def field_pixels(n_pix: int, spot_px: float) -> int:
    """Pixels rendered per lenslet: one alias period of its samples, so that no light is counted twice."""
    return int(n_pix * spot_px)


def first_pixels(centres_px: NDArray[np.floating], field: int) -> NDArray[np.intp]:
    """First of the ``field`` pixels around each lenslet centre along one axis."""
    return np.asarray(np.floor(centres_px - field / 2 + 1), dtype=np.intp)


def lenslet_transform(
    centres_px: NDArray[np.floating], first_px: NDArray[np.intp], n_pix: int, field: int, spot_px: float
) -> NDArray[np.complex128]:
    """Fourier matrices from the pupil samples of lenslets to camera pixels, along one axis.

    Parameters
    ----------
    centres_px, first_px
        Centre of each lenslet, and first pixel rendered for it, in camera pixels ``(n_sub,)``.
    n_pix, field
        Pupil samples across a lenslet, and pixels rendered per lenslet.
    spot_px
        lambda/d in camera pixels.

    Returns
    -------
    ndarray of complex, ``(n_sub, n_pix, field)``
        Normalised so that a whole alias period of the image contains the power of the pupil.
    """
    pixels = first_px[:, None] + np.arange(field)[None, :] - centres_px[:, None]
    samples = (np.arange(n_pix) - (n_pix - 1) / 2) / n_pix
    # With the minus sign a positive slope of the path moves the spot to higher pixels, as in OOPAO.
    phase = -2j * np.pi * samples[None, :, None] * pixels[:, None, :] / spot_px
    return np.asarray(np.exp(phase) / np.sqrt(n_pix * spot_px), dtype=np.complex128)


class LensletOptics(SensorOptics):
    """Geometry of a Shack-Hartmann sensor on a camera whose pixels need not match the lenslets.

    Every lenslet forms an image on the ``field`` pixels around it; images of neighbours add as
    intensities. A positive slope of the optical path along x moves spots to higher columns.

    Parameters
    ----------
    n_sub, n_pix
        Lenslets across the grid, and pupil samples across a lenslet.
    pitch_px, spot_px
        Lenslet pitch and lambda/d in camera pixels.
    origin_px
        Centre (x, y) of lenslet (0, 0) in pixels.
    shape
        Camera region (rows, columns).
    amplitude
        Pupil amplitude ``(n_sub * n_pix, n_sub * n_pix)``; lenslets without light are skipped.

    Raises
    ------
    ValueError
        The amplitude has another shape, or a lit lenslet is outside the region.
    """

    def __init__(
        self,
        n_sub: int,
        n_pix: int,
        wavelength_m: float,
        pitch_px: float,
        spot_px: float,
        origin_px: tuple[float, float],
        shape: tuple[int, int],
        amplitude: NDArray[np.float32],
    ) -> None:
        n = n_sub * n_pix
        if amplitude.shape != (n, n):
            raise ValueError(
                f"amplitude has shape {amplitude.shape}; {n_sub} x {n_pix} samples need ({n}, {n})"
            )
        super().__init__(amplitude, shape)
        self._n_sub, self._n_pix, self._size = n_sub, n_pix, field_pixels(n_pix, spot_px)
        self._x, self._y = (origin + np.arange(n_sub) * pitch_px for origin in origin_px)
        self._x0, self._y0 = (first_pixels(centres, self._size) for centres in (self._x, self._y))
        self._lit = amplitude.reshape(n_sub, n_pix, n_sub, n_pix).any(axis=(1, 3))
        outside = np.zeros_like(self._lit)
        outside |= (self._x0 < 0) | (self._x0 + self._size > shape[1])
        outside |= ((self._y0 < 0) | (self._y0 + self._size > shape[0]))[:, None]
        if (outside & self._lit).any():
            raise ValueError(
                f"{int((outside & self._lit).sum())} lit lenslets fall outside the region "
                f"of {shape[1]} x {shape[0]} pixels; enlarge the camera region or move the grid's origin"
            )
        self._prepare(wavelength_m, spot_px)

    @abc.abstractmethod
    def _prepare(self, wavelength_m: float, spot_px: float) -> None:
        """Compute what is the same for every frame."""


class ShackHartmannOptics(LensletOptics):
    """Diffractive Shack-Hartmann optics; parameters of :class:`LensletOptics`."""

    def _prepare(self, wavelength_m: float, spot_px: float) -> None:
        k, p, f = self._n_sub, self._n_pix, self._size
        self._per_wave = np.float32(1 / wavelength_m)
        self._along_x = lenslet_transform(self._x, self._x0, p, f, spot_px).astype(np.complex64)
        along_y = lenslet_transform(self._y, self._y0, p, f, spot_px).astype(np.complex64)
        self._along_y = np.ascontiguousarray(along_y.transpose(0, 2, 1))
        self._field = np.empty((k * p, k * p), np.complex64)
        self._half = np.empty((k * p, k, f), np.complex64)
        self._spots = np.empty((k, f, k * f), np.complex64)

    def _add_intensity(self, opd_m: NDArray[np.floating], out: NDArray[np.floating]) -> None:
        opd = np.ascontiguousarray(opd_m, dtype=np.float32)
        k, p, f = self._n_sub, self._n_pix, self._size
        pupil_field(
            opd.ravel(), self._per_wave, self.amplitude.ravel(), self._field.view(np.float32).reshape(-1, 2)
        )
        # One product per lenslet column, then one per lenslet row.
        columns = self._field.reshape(k * p, k, p).transpose(1, 0, 2)
        np.matmul(columns, self._along_x, out=self._half.transpose(1, 0, 2))
        np.matmul(self._along_y, self._half.reshape(k, p, k * f), out=self._spots)
        _add_intensities(
            self._spots.view(np.float32).reshape(k, f, k, f, 2), self._lit, self._y0, self._x0, out
        )
