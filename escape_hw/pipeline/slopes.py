"""Shack-Hartmann slopes: thresholded centre of gravity on a grid that need not match the pixels."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from escape_hw.api.sensor import SubApertureGrid


def windows(centres_px: NDArray[np.float64], pitch_px: float, shape: tuple[int, int]) -> NDArray[np.int32]:
    """Whole-pixel windows of the sub-apertures.

    A window holds the pixels whose centres lie within half a pitch of the lenslet's centre, so
    every pixel belongs to one lenslet.

    Parameters
    ----------
    centres_px
        Lenslet centres ``(n, 2)`` as (x, y).
    pitch_px
        Lenslet pitch in pixels.
    shape
        Region (rows, columns); windows are cut at its edge.

    Returns
    -------
    ndarray of int32, ``(n, 4)``
        First row, end row, first column, end column.
    """
    low = np.ceil(centres_px - pitch_px / 2).astype(np.int32)
    high = np.ceil(centres_px + pitch_px / 2).astype(np.int32)
    rows, columns = shape
    return np.stack(
        [
            np.clip(low[:, 1], 0, rows),
            np.clip(high[:, 1], 0, rows),
            np.clip(low[:, 0], 0, columns),
            np.clip(high[:, 0], 0, columns),
        ],
        axis=1,
    )


@njit(cache=True, fastmath=True, nogil=True)
def centres_of_gravity(frame, dark, gain, boxes, centres, references, threshold, slopes, flux):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Thresholded centre of gravity of every window, minus centre and reference.

    Each pixel counts as ``max((frame - dark) * gain - threshold, 0)``. A window without light above
    the threshold yields slope 0 and flux 0. Fills ``slopes (2 n,)`` (all x, then all y) and
    ``flux (n,)``.
    """
    n = boxes.shape[0]
    for k in range(n):
        left = boxes[k, 2]
        width = boxes[k, 3] - left
        total = np.float32(0)
        first = np.float32(0)
        down = np.float32(0)
        for i in range(boxes[k, 0], boxes[k, 1]):
            line = np.float32(0)
            for j in range(width):
                value = (np.float32(frame[i, left + j]) - dark[i, left + j]) * gain[i, left + j] - threshold
                value = max(value, np.float32(0))
                line += value
                first += value * np.float32(j)
            total += line
            down += line * np.float32(i - boxes[k, 0])
        flux[k] = total
        if total > np.float32(0):
            slopes[k] = np.float32(left - centres[k, 0]) + first / total - references[k, 0]
            slopes[n + k] = np.float32(boxes[k, 0] - centres[k, 1]) + down / total - references[k, 1]
        else:
            slopes[k] = np.float32(0)
            slopes[n + k] = np.float32(0)


class SlopeExtractor:
    """Slopes of one grid on one camera region.

    Parameters
    ----------
    grid
        The sub-aperture grid.
    shape
        Region (rows, columns).
    dark
        Dark frame in counts, zeros by default.
    flat
        Relative pixel response, ones by default.
    threshold
        Level in counts above the dark that is subtracted before the centre of gravity.

    Raises
    ------
    ValueError
        Frame, dark or flat do not fit each other.
    """

    def __init__(
        self,
        grid: SubApertureGrid,
        shape: tuple[int, int],
        *,
        dark: NDArray[np.float32] | None = None,
        flat: NDArray[np.float32] | None = None,
        threshold: float = 0.0,
    ) -> None:
        self.grid, self.shape = grid, shape
        self.dark = np.zeros(shape, np.float32) if dark is None else np.ascontiguousarray(dark, np.float32)
        response = np.ones(shape, np.float32) if flat is None else np.asarray(flat, np.float32)
        if self.dark.shape != shape or response.shape != shape:
            raise ValueError(f"dark {self.dark.shape} and flat {response.shape} must have the region's {shape}")
        if not (response > 0).all():
            raise ValueError("the flat has pixels that are not positive")
        self._gain = np.ascontiguousarray(1 / response)
        self.threshold = float(threshold)
        self._centres = grid.centres_px()
        self._boxes = windows(self._centres, grid.pitch_px, shape)
        self._references = np.ascontiguousarray(grid.references_px, np.float32)

    def __call__(
        self, frame: NDArray[np.uint16], flux: NDArray[np.float32] | None = None
    ) -> NDArray[np.float32]:
        """Slopes ``(n_slopes,)`` in pixels; ``flux (n_valid,)`` is filled when given."""
        if frame.shape != self.shape:
            raise ValueError(f"frame has shape {frame.shape}; the slopes were set up for {self.shape}")
        slopes = np.empty(self.grid.n_slopes, np.float32)
        light = np.empty(self.grid.n_valid, np.float32) if flux is None else flux
        centres_of_gravity(
            frame, self.dark, self._gain, self._boxes, self._centres, self._references,
            np.float32(self.threshold), slopes, light,
        )  # fmt: skip
        return slopes
