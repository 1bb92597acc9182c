"""Slope vectors, actuator vectors and images: maps and radial profiles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from escape_hw.remote.state import Geometry

#: Columns between the map of x and that of y.
MAP_GAP = 1
#: Pixels across a map of actuators that stand on no grid.
_IMAGE_WIDTH = 160


def mask_from_rows(rows: tuple[str, ...]) -> NDArray[np.bool_]:
    """The mask ``(rows, columns)`` that :class:`Geometry` writes as rows of 0 and 1."""
    return np.array([[one == "1" for one in row] for row in rows], dtype=bool).reshape(
        len(rows), len(rows[0]) if rows else 0
    )


def slope_map_pair(slopes: NDArray[np.floating], valid: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Maps of x and y side by side ``(rows, 2 columns + MAP_GAP)``, NaN where there are none.

    Parameters
    ----------
    slopes
        All x, then all y ``(2 n_valid,)``.
    valid
        Valid sub-apertures or pupil pixels ``(rows, columns)``.
    """
    rows, columns = valid.shape
    maps = np.full((rows, 2 * columns + MAP_GAP), np.nan, np.float32)
    x, y = slopes.reshape(2, -1)
    maps[:, :columns][valid] = x
    maps[:, columns + MAP_GAP :][valid] = y
    return maps


class ActuatorImage:
    """Where each actuator's value goes: its own square on a grid, or the place nearest to it.

    Parameters
    ----------
    geometry
        Layout or places.
    """

    def __init__(self, geometry: Geometry) -> None:
        if geometry.layout:
            mask = mask_from_rows(geometry.layout)
            numbers = np.full(mask.shape, -1)
            numbers[mask] = np.arange(int(mask.sum()))
        else:
            numbers = _nearest_actuator(np.asarray(geometry.positions_m, float).reshape(-1, 2))
        self.numbers = numbers
        self.n_act = int(numbers.max()) + 1 if numbers.size else 0
        self._outside = numbers < 0

    def picture(self, values: NDArray[np.floating]) -> NDArray[np.float32]:
        """The picture ``(rows, columns)`` of values ``(n_act,)``, NaN where no actuator is."""
        picture: NDArray[np.float32] = np.asarray(values, np.float32)[self.numbers]
        picture[self._outside] = np.nan
        return picture


def _nearest_actuator(places: NDArray[np.float64]) -> NDArray[np.intp]:
    """Number of the nearest actuator for each pixel, -1 further off than they stand apart."""
    if len(places) < 2:
        return np.zeros((0, 0), np.intp)
    # It takes half a second to load, and most mirrors have a grid.
    from scipy.spatial import cKDTree

    tree = cKDTree(places)
    apart = float(np.median(tree.query(places, k=2)[0][:, 1]))
    low, high = places.min(axis=0) - apart, places.max(axis=0) + apart
    x, y = (np.linspace(low[k], high[k], _IMAGE_WIDTH) for k in (0, 1))
    distance, number = tree.query(np.stack(np.meshgrid(x, y[::-1]), axis=-1))
    return np.where(distance <= 0.9 * apart, number, -1)


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
