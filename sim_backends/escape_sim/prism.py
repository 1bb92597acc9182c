"""The pyramid prism: four plane faces, from the positions of the four pupil images."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Prism:
    """Four planes that meet in an edge each, and in one point unless there is a roof.

    A face tilts the light that falls on it and so moves its image of the pupil; the tilt is the
    gradient of the face. The glass is the uppermost of the four planes everywhere (as in OOPAO's
    ``Pyramid.get_phase_mask``), so faces of unequal tilt meet along edges that are not quite square.

    Parameters
    ----------
    shifts
        Shift ``(4, 2)`` as (x, y) of each image in pupil samples: upper left, upper right, lower
        left, lower right.
    rooftop
        Length of the ridge that stands in place of the apex, in samples of ``1 / D`` spatial
        frequency (lambda/D), for a pupil of ``diameter`` samples; negative for the other diagonal.
    diameter
        Pupil diameter in samples.
    """

    shifts: NDArray[np.float64]
    diameter: float
    rooftop: float = 0.0

    def __post_init__(self) -> None:
        shifts = np.array(self.shifts, dtype=float)
        if shifts.shape != (4, 2) or not np.isfinite(shifts).all():
            raise ValueError(f"the images of a pyramid are four points (x, y); these are {shifts.shape}")
        ul, ur, ll, lr = shifts
        if not (max(ul[0], ll[0]) < min(ur[0], lr[0]) and max(ul[1], ur[1]) < min(ll[1], lr[1])):
            raise ValueError(
                "the four images must come in the order upper left, upper right, lower left, lower right"
            )
        object.__setattr__(self, "shifts", shifts)

    def mask(self, n_grid: int) -> NDArray[np.complex128]:
        """Transmission ``(n_grid, n_grid)``, rows along y, on the frequencies of :func:`frequencies`."""
        kx, ky = np.meshgrid(frequencies(n_grid), frequencies(n_grid))
        planes = 2 * np.pi * (self.shifts[:, :1, None] * kx + self.shifts[:, 1:, None] * ky)
        planes[[0, 3]] += self.roof_height
        return np.asarray(np.exp(-1j * planes.max(axis=0)))

    def half_distances(self, middle: float) -> tuple[float, float] | None:
        """Half the distances of images that stand on a rectangle around a shift of ``middle``.

        None if they do not. Only then is the transmission a product of a factor along x and one
        along y, both the same to either side.
        """
        signs = np.array([[-1, -1], [1, -1], [-1, 1], [1, 1]])
        half = (self.shifts - middle)[3]
        if self.rooftop or np.abs(self.shifts - middle - signs * half).max() > 1e-9:
            return None
        return float(half[0]), float(half[1])

    @property
    def roof_height(self) -> float:
        """Phase in radians by which the upper left and lower right faces are raised."""
        # With images at (+-r, +-r), two raised planes meet along a diagonal from (-k, k) to (k, -k),
        # where a third plane is as high: 4 pi r k = height. The ridge is sqrt(8) k long.
        r = np.abs(self.shifts - self.shifts.mean(axis=0)).mean()
        return float(np.sqrt(2) * np.pi * r * self.rooftop / self.diameter)


def frequencies(n_grid: int) -> NDArray[np.float64]:
    """Spatial frequencies of the focal plane in cycles per sample: the apex lies between four of them."""
    return (np.arange(n_grid) - (n_grid - 1) / 2) / n_grid
