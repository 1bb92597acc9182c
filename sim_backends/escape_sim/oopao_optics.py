"""OOPAO as the twin's Shack-Hartmann optics (``system.optics = "oopao"``): slow, for reference."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from escape_sim.oopao_bridge import make_lenslets, make_light, oopao, quiet
from escape_sim.oopao_readout import SAMPLING, read_off
from escape_sim.shack_hartmann import field_pixels, first_pixels


class OOPAOShackHartmann:
    """The interface of ``ShackHartmannOptics`` with OOPAO doing the propagation.

    OOPAO's detector has a whole number of pixels per lenslet and a pixel scale of lambda/d over a
    whole number, which is not what the bench's camera has. Each lenslet is therefore computed by
    OOPAO at two pixels per lambda/d over its full field and then read off at the camera's pixels by
    trigonometric interpolation, which is exact. What OOPAO does by itself is the pupil, the
    field and its diffraction by the lenslets.

    Parameters
    ----------
    n_sub, n_pix, wavelength_m, pitch_px, spot_px, origin_px, shape, amplitude
        As for ``ShackHartmannOptics``; ``n_pix`` must be even.

    Raises
    ------
    ConfigError
        OOPAO is not installed.
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
        if n_pix % 2:
            raise ValueError(f"{n_pix} samples per lenslet; OOPAO centres its spots on an even number only")
        self.shape = shape
        self.amplitude = np.ascontiguousarray(amplitude, dtype=np.float32)
        # Only angles count, so the size of the pupil is free: one metre per lenslet.
        self._light = make_light(self.amplitude, float(n_sub), wavelength_m)
        self._sensor = make_lenslets(self._light, n_sub, SAMPLING * n_pix)
        self._data = self._sensor.sh_data["src_0"]
        self._lit = np.argwhere(self._data.valid_subapertures)

        field = field_pixels(n_pix, spot_px)
        self._field = field
        line = np.arange(n_sub) * pitch_px
        self._first: list[NDArray[np.intp]] = []
        self._read: list[NDArray[np.float64]] = []
        for start, length in zip(origin_px, shape[::-1], strict=True):
            centres = np.asarray(start + line, dtype=np.float64)
            first = first_pixels(centres, field)
            pixels = first[:, None] + np.arange(field) - centres[:, None]
            self._first.append(first)
            self._read.append(read_off(pixels, n_pix, spot_px))
            self._require_inside(first, length)

    def _require_inside(self, first: NDArray[np.intp], length: int) -> None:
        axis = self._lit[:, 1] if len(self._first) == 1 else self._lit[:, 0]
        used = first[axis]
        if used.min() < 0 or used.max() + self._field > length:
            raise ValueError(
                f"lit lenslets fall outside the region of {self.shape[1]} x {self.shape[0]} pixels; "
                "enlarge the camera region or move the grid's origin"
            )

    def frame(
        self, opd_m: NDArray[np.float32], image: NDArray[np.float32] | None = None
    ) -> NDArray[np.float32]:
        """Intensity on the camera.

        Parameters
        ----------
        opd_m
            Optical path difference ``(n, n)`` in metres.
        image
            Where to put the result; added to, so clear it first. A new array by default.

        Returns
        -------
        ndarray of float32, ``(rows, columns)``
            Sums (but for light beyond the field of a lenslet) to the sum of ``amplitude ** 2``.
        """
        if opd_m.shape != self.amplitude.shape:
            raise ValueError(f"the optical path has shape {opd_m.shape}, the pupil {self.amplitude.shape}")
        out = np.zeros(self.shape, np.float32) if image is None else image
        spots = self._spots(opd_m)
        x0, y0 = self._first
        read_x, read_y = self._read
        size = self._field
        for (i, j), spot in zip(self._lit, spots, strict=True):
            # OOPAO lays the image of a lenslet down with x along its rows.
            out[y0[i] : y0[i] + size, x0[j] : x0[j] + size] += read_y[i] @ spot.T @ read_x[j].T
        return out

    def _spots(self, opd_m: NDArray[np.float32]) -> NDArray[np.float64]:
        """OOPAO's images of the lit lenslets ``(n_lit, period, period)``."""
        light = self._light
        with quiet():
            # '**' starts a new propagation; '*' alone would add to the last one.
            light.source**light.telescope * oopao().OPD_map(np.asarray(opd_m, dtype=float)) * self._sensor
            return np.asarray(self._sensor.maps_intensity) / light.unit
