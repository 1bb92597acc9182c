"""Maps of slopes and actuator values, and radial profiles of images."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.remote.state import Geometry

#: Columns between the maps of x and y.
MAP_GAP = 1
#: Width of the image of actuators that are not on a grid, pixels.
_IMAGE_WIDTH = 160


def mask_from_rows(rows: tuple[str, ...]) -> NDArray[np.bool_]:
    """Mask ``(rows, columns)`` from the strings of 0 and 1 of :class:`Geometry`."""
    return np.array([[digit == "1" for digit in row] for row in rows], dtype=bool).reshape(
        len(rows), len(rows[0]) if rows else 0
    )


def slope_map_pair(slopes: NDArray[np.floating], valid: NDArray[np.bool_]) -> NDArray[np.floating]:
    """Maps of x and y side by side ``(rows, 2 * columns + MAP_GAP)``, NaN outside the pupil.

    Slopes ``(2 * n_valid,)`` are all x, then all y; ``valid`` is ``(rows, columns)``.
    """
    rows, columns = valid.shape
    maps = np.full((rows, 2 * columns + MAP_GAP), np.nan, slopes.dtype)
    x, y = slopes.reshape(2, -1)
    maps[:, :columns][valid] = x
    maps[:, columns + MAP_GAP :][valid] = y
    return maps


class ActuatorImage:
    """Maps actuator values to an image: one pixel per actuator of a grid, else the nearest actuator."""

    def __init__(self, geometry: Geometry) -> None:
        if geometry.layout:
            mask = mask_from_rows(geometry.layout)
            numbers = np.full(mask.shape, -1)
            numbers[mask] = np.arange(int(mask.sum()))
        else:
            numbers = _nearest_actuator(np.asarray(geometry.positions_m, float).reshape(-1, 2))
        self.numbers = numbers
        self.n_act = int(numbers.max()) + 1 if numbers.size else 0

    def to_image(self, values: NDArray[np.floating]) -> NDArray[np.float32]:
        """Image ``(rows, columns)`` of values ``(n_act,)``, NaN where there is no actuator."""
        image: NDArray[np.float32] = np.asarray(values, np.float32)[self.numbers]
        image[self.numbers < 0] = np.nan
        return image


def _nearest_actuator(positions: NDArray[np.float64]) -> NDArray[np.intp]:
    """Index of the nearest actuator for each pixel, -1 at distances above 0.9 of the actuator pitch."""
    if len(positions) < 2:
        return np.zeros((0, 0), np.intp)
    # Imported here: it takes half a second, and most mirrors have a grid.
    from scipy.spatial import cKDTree

    tree = cKDTree(positions)
    pitch = float(np.median(tree.query(positions, k=2)[0][:, 1]))
    low, high = positions.min(axis=0) - pitch, positions.max(axis=0) + pitch
    x, y = (np.linspace(low[k], high[k], _IMAGE_WIDTH) for k in (0, 1))
    distance, number = tree.query(np.stack(np.meshgrid(x, y[::-1]), axis=-1))
    return np.where(distance <= 0.9 * pitch, number, -1)


class FrameAverage:
    """Mean of the frames shown last, with exponential weights that correspond to ``frames`` frames."""

    def __init__(self) -> None:
        self.frames, self.count = 1, 0
        self._mean: NDArray[np.float32] | None = None

    def __call__(self, frame: NDArray[Any]) -> NDArray[Any]:
        """Add a frame ``(rows, columns)``; returns the mean, or the frame itself if ``frames`` is 1."""
        if self.frames == 1:
            self.clear()
            return frame
        if self._mean is None or self._mean.shape != frame.shape:
            self._mean, self.count = frame.astype(np.float32), 1
        else:
            self.count = min(self.count + 1, self.frames)
            self._mean = self._mean + (frame - self._mean) / np.float32(self.count)
        return self._mean

    def clear(self) -> None:
        self._mean, self.count = None, 0


class RadialProfile:
    """Means over rings of one pixel width around ``centre`` (row, column), out to the nearest edge."""

    def __init__(self, shape: tuple[int, ...], centre: tuple[int, int]) -> None:
        self.shape, self.centre = shape, centre
        y, x = np.indices(shape)
        ring = np.rint(np.hypot(y - centre[0], x - centre[1])).astype(np.intp)
        self._rings = max(1, min(*centre, shape[0] - 1 - centre[0], shape[1] - 1 - centre[1]))
        self._ring = ring.ravel()
        self._pixels = np.maximum(np.bincount(self._ring), 1)

    def __call__(self, image: NDArray[np.floating]) -> NDArray[np.float64]:
        """Mean at radius 0, 1, ... pixels ``(n,)``."""
        sums = np.bincount(self._ring, weights=np.asarray(image, float).ravel())
        means: NDArray[np.float64] = (sums / self._pixels)[: self._rings]
        return means
