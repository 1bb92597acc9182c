"""Shack-Hartmann slopes: thresholded centre of gravity on a grid that need not match the pixels."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from escape_hw.api.sensor import SubApertureGrid
from escape_hw.pipeline.slopes.base import FrameSlopes

#: Single-precision numbers in a vector register of common processors.
_VECTOR = 8


def subaperture_windows(
    centres_px: NDArray[np.float64], pitch_px: float, shape: tuple[int, int]
) -> NDArray[np.int32]:
    """Windows of the sub-apertures in whole pixels.

    A window contains the pixels whose centres are within half a pitch of the lenslet's centre, so every pixel
    belongs to one lenslet.

    Returns ``(n, 4)``: first row, end row, first column, end column.

    Parameters
    ----------
    centres_px
        Lenslet centres ``(n, 2)`` as (x, y).
    pitch_px
        Lenslet pitch in pixels.
    shape
        Region (rows, columns), which limits the windows.
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


@njit(inline="always")
def _calibrate_pixel(frame, gain, offset, at, pixel):  # type: ignore[no-untyped-def]  # pragma: no cover
    value = np.float32(frame[at]) * gain[pixel] - offset[pixel]
    return value if value > np.float32(0) else np.float32(0)


@njit(cache=True, fastmath=True, nogil=True)
def centres_of_gravity(frame, gain, offset, per_pixel, places, weights, zero_points, slopes, flux):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Thresholded centre of gravity of every window, minus centre and reference.

    Calibrated pixels are ``max(frame * gain - offset, 0)``. With ``per_pixel`` 1, gain and offset have the
    frame's shape; with 0 they are ``(width,)`` equal numbers, which saves cache. A window without light above
    the threshold has slope 0 and flux 0. ``places (n, 3)`` are each window's first row, number of rows and
    first column, ``weights (n, 2, width)`` its mask and its x coordinates, ``zero_points (2 n,)`` the values
    to subtract. Writes ``slopes (2 n,)`` (all x, then all y) and ``flux (n,)``.

    For speed, all windows have the same width, a whole number of vectors, with zero weights beyond their end;
    the inner loop processes four rows together, because the sum across a vector is slow; and indices are
    unsigned, because numba does not vectorise with a check for negative ones.
    """
    zero, two, three = np.float32(0), np.float32(2), np.float32(3)
    pixels, scale, cut = frame.ravel(), gain.ravel(), offset.ravel()
    weight = weights.ravel()
    width, stride = np.uint64(weights.shape[2]), np.uint64(frame.shape[1])
    n = weights.shape[0]
    for k in range(n):
        total = zero
        first = zero
        down = zero
        mask_start = np.uint64(2 * k) * width
        lever = mask_start + width
        at = np.uint64(places[k, 0]) * stride + np.uint64(places[k, 2])
        rows = places[k, 1]
        i = 0
        while i + 4 <= rows:
            at1 = at + stride
            at2 = at1 + stride
            at3 = at2 + stride
            block = zero
            weighted_rows = zero
            for j in range(width):
                v0 = _calibrate_pixel(pixels, scale, cut, at + j, per_pixel * at + j)
                v1 = _calibrate_pixel(pixels, scale, cut, at1 + j, per_pixel * at1 + j)
                v2 = _calibrate_pixel(pixels, scale, cut, at2 + j, per_pixel * at2 + j)
                v3 = _calibrate_pixel(pixels, scale, cut, at3 + j, per_pixel * at3 + j)
                column = v0 + v1 + v2 + v3
                block += column * weight[mask_start + j]
                first += column * weight[lever + j]
                weighted_rows += (v1 + two * v2 + three * v3) * weight[mask_start + j]
            total += block
            down += block * np.float32(i) + weighted_rows
            i += 4
            at = at3 + stride
        while i < rows:
            line = zero
            for j in range(width):
                value = _calibrate_pixel(pixels, scale, cut, at + j, per_pixel * at + j)
                line += value * weight[mask_start + j]
                first += value * weight[lever + j]
            total += line
            down += line * np.float32(i)
            i += 1
            at += stride
        flux[k] = total
        if total > zero:
            slopes[k] = first / total - zero_points[k]
            slopes[n + k] = down / total - zero_points[n + k]
        else:
            slopes[k] = zero
            slopes[n + k] = zero


class ShackHartmannSlopes(FrameSlopes[SubApertureGrid]):
    """Slope function of a grid on a camera region.

    Raises
    ------
    ValueError
        Region, dark and flat have different shapes.
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
        super().__init__(grid, shape, dark, flat, threshold)
        centres = self.grid.centres_px()
        boxes = subaperture_windows(centres, self.grid.pitch_px, self.shape).astype(np.int64)
        top, end, left, right = boxes.T
        widest = int((right - left).max(initial=1))
        width = min(-(-widest // _VECTOR) * _VECTOR, self.shape[1])
        start = np.minimum(left, self.shape[1] - width)
        self._places = np.ascontiguousarray(np.stack([top, end - top, start], axis=1))
        at = start[:, None] + np.arange(width)
        inside = (at >= left[:, None]) & (at < right[:, None])
        lever = np.where(inside, at - centres[:, :1], 0.0)
        self._weights = np.ascontiguousarray(np.stack([inside, lever], axis=1), np.float32)
        uniform = np.ptp(self._gain) == 0 and np.ptp(self._offset) == 0
        self._per_pixel = np.uint64(0 if uniform else 1)
        self._scale = self._gain[0, :width].copy() if uniform else self._gain
        self._cut = self._offset[0, :width].copy() if uniform else self._offset
        x, y = self.grid.references_px.T.astype(float)
        self._zero_points = np.concatenate([x, y + centres[:, 1] - top]).astype(np.float32)

    def _compute(
        self, frame: NDArray[np.uint16], slopes: NDArray[np.float32], light: NDArray[np.float32]
    ) -> None:
        centres_of_gravity(
            frame, self._scale, self._cut, self._per_pixel, self._places, self._weights, self._zero_points,
            slopes, light,
        )  # fmt: skip
