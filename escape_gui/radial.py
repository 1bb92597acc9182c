"""Means over rings about a pixel."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


class RadialProfile:
    """Means over rings one pixel wide, out to the nearest edge.

    Parameters
    ----------
    shape
        Rows and columns of the images.
    centre
        Row and column about which the rings lie.
    """

    def __init__(self, shape: tuple[int, ...], centre: tuple[int, int]) -> None:
        self.shape, self.centre = shape, centre
        y, x = np.indices(shape)
        ring = np.rint(np.hypot(y - centre[0], x - centre[1])).astype(np.intp)
        self._rings = max(1, min(*centre, shape[0] - 1 - centre[0], shape[1] - 1 - centre[1]))
        self._ring = ring.ravel()
        self._pixels = np.maximum(np.bincount(self._ring), 1)

    def __call__(self, image: NDArray[np.floating]) -> NDArray[np.float64]:
        """Mean by radius in pixels ``(n,)``, from 0."""
        sums = np.bincount(self._ring, weights=np.asarray(image, float).ravel())
        means: NDArray[np.float64] = (sums / self._pixels)[: self._rings]
        return means
