"""Diffractive Shack-Hartmann optics whose lenslet grid is clocked and distorted on the camera."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from escape_sim.optics.shack_hartmann import LensletOptics, first_pixels, pupil_field


@njit(cache=True, fastmath=True, nogil=True)
def _add_boxes(spots, top, left, image):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add the intensity of ``spots (n_lit, field, field, 2)``, real and imaginary part, to the image."""
    for k in range(spots.shape[0]):
        for v in range(spots.shape[1]):
            for u in range(spots.shape[2]):
                re = spots[k, v, u, 0]
                im = spots[k, v, u, 1]
                image[top[k] + v, left[k] + u] += re * re + im * im


class DistortedShackHartmannOptics(LensletOptics):
    """Shack-Hartmann optics with lenslets anywhere on the camera; slower than on a square grid.

    The image of every lenslet is one matrix product, the same for all, after a tilt that moves it within a
    pixel.

    Parameters
    ----------
    *geometry
        As for :class:`~escape_sim.optics.shack_hartmann.LensletOptics`.
    clocking
        Rotation in radians, from +x towards +y, of the grid about its centre and of the images of the
        lenslets about theirs: a spot that a slope along x moves goes in this direction.
    distortion
        Displacement of a lenslet's centre at half the width of the grid, as a fraction of that distance; it
        grows with the cube of the distance. The images of the lenslets are not distorted.

    Raises
    ------
    ValueError
        As for :class:`~escape_sim.optics.shack_hartmann.LensletOptics`.
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
        *,
        clocking: float = 0.0,
        distortion: float = 0.0,
    ) -> None:
        c, s = np.cos(clocking), np.sin(clocking)
        self._turn, self._distortion, self._half_width = (
            np.array([[c, -s], [s, c]]),
            distortion,
            n_sub * pitch_px / 2,
        )
        super().__init__(n_sub, n_pix, wavelength_m, pitch_px, spot_px, origin_px, shape, amplitude)

    @property
    def centres_px(self) -> NDArray[np.float64]:
        """Centres ``(n_lit, 2)`` of the lit lenslets in pixels as (x, y), in row-major order."""
        centre = np.array([self._x.mean(), self._y.mean()])
        offsets = np.stack(np.meshgrid(self._x, self._y), axis=-1)[self._lit] - centre
        squares = np.square(offsets / self._half_width).sum(axis=1, keepdims=True)
        return np.asarray(centre + (1 + self._distortion * squares) * (offsets @ self._turn.T))

    def _prepare(self, wavelength_m: float, spot_px: float) -> None:
        p, f, centres = self._n_pix, self._size, self.centres_px
        self._per_wave = np.float32(1 / wavelength_m)
        first = first_pixels(centres, f)
        if (first < 0).any() or (first + f > self.shape[::-1]).any():
            raise ValueError(
                f"lit lenslets fall outside the region of {self.shape[1]} x {self.shape[0]} pixels; enlarge "
                "the camera region, or reduce twin.wfs.clocking_deg and twin.wfs.distortion"
            )
        self._left, self._top = np.ascontiguousarray(first.T)
        line = (np.arange(p) - (p - 1) / 2) / p
        # Samples (x, y) of a lenslet on the pupil, row by row, turned to the axes of the camera.
        samples = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2) @ self._turn.T
        pixels = np.stack(np.meshgrid(np.arange(f), np.arange(f)), axis=-1).reshape(-1, 2) - f / 2
        # As in lenslet_transform(): each axis has the factor 1 / sqrt(n_pix spot_px).
        image = np.exp(-2j * np.pi / spot_px * samples @ pixels.T) / (p * spot_px)
        self._to_image = image.astype(np.complex64)
        tilt = np.exp(2j * np.pi / spot_px * (centres - first - f / 2) @ samples.T)
        self._tilt = tilt.astype(np.complex64)
        self._field = np.empty(self.amplitude.shape, np.complex64)

    def _add_intensity(self, opd_m: NDArray[np.floating], out: NDArray[np.floating]) -> None:
        opd = np.ascontiguousarray(opd_m, dtype=np.float32)
        k, p, f = self._n_sub, self._n_pix, self._size
        pupil_field(
            opd.ravel(), self._per_wave, self.amplitude.ravel(), self._field.view(np.float32).reshape(-1, 2)
        )
        lenslets = self._field.reshape(k, p, k, p).transpose(0, 2, 1, 3)[self._lit].reshape(-1, p * p)
        spots = (lenslets * self._tilt) @ self._to_image
        _add_boxes(spots.view(np.float32).reshape(-1, f, f, 2), self._top, self._left, out)
