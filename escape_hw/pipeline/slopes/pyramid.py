"""Pyramid slopes: normalised differences of the four pupil images, pixel by pixel."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from escape_hw.api.pyramid import PyramidPupils
from escape_hw.pipeline.slopes.base import FrameSlopes


def slopes_of_image(image: NDArray[Any], pupils: PyramidPupils) -> NDArray[np.float64]:
    """Slopes ``(n_slopes,)`` of a calibrated image, without compiled code; see :class:`PyramidPupils`.

    ``image``: light per pixel ``(rows, columns)``, background subtracted, in any unit.
    """
    n = pupils.valid.shape[0]
    ul, ur, ll, lr = (
        np.asarray(image[y : y + n, x : x + n], dtype=float)[pupils.valid] for x, y in pupils.corners_px
    )
    light = ul + ur + ll + lr
    norm = np.full(light.shape, light.mean()) if pupils.normalisation == "global" else light
    raw = np.stack([ur + lr - ul - ll, ll + lr - ul - ur])
    slopes = np.divide(raw, norm, out=np.zeros_like(raw), where=norm > 0)
    return np.asarray((slopes - np.where(norm > 0, pupils.references.T, 0.0)).ravel())


@njit(inline="always")
def _calibrate_pixel(frame, gain, offset, at):  # type: ignore[no-untyped-def]  # pragma: no cover
    return np.float32(frame[at]) * gain[at] - offset[at]


@njit(cache=True, fastmath=True, nogil=True)
def quad_cell_slopes(frame, gain, offset, corners, runs, zero_points, local, slopes, flux):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Normalised differences of four images, minus references.

    Calibrated pixels are ``frame * gain - offset``. ``corners (4,)`` are the indices of each image's box in
    the flattened frame; ``runs (m, 3)`` are offset in a box, length and first pixel number of each contiguous
    run of valid pixels, so that the inner loop reads four lines. Writes ``slopes (2 n,)`` (all x, then all y)
    and ``flux (n,)``, the sum of the four images. Slopes without light are 0.
    """
    pixels, scale, cut = frame.ravel(), gain.ravel(), offset.ravel()
    n = flux.size
    a, b, c, d = corners[0], corners[1], corners[2], corners[3]
    total = np.float64(0)
    for r in range(runs.shape[0]):
        start, length, first = np.uint64(runs[r, 0]), np.uint64(runs[r, 1]), np.uint64(runs[r, 2])
        line = np.float32(0)
        for j in range(length):
            ul = _calibrate_pixel(pixels, scale, cut, a + start + j)
            ur = _calibrate_pixel(pixels, scale, cut, b + start + j)
            ll = _calibrate_pixel(pixels, scale, cut, c + start + j)
            lr = _calibrate_pixel(pixels, scale, cut, d + start + j)
            light = ul + ur + ll + lr
            slopes[first + j] = ur + lr - ul - ll
            slopes[np.uint64(n) + first + j] = ll + lr - ul - ur
            flux[first + j] = light
            line += light
        total += line
    zero, one = np.float32(0), np.float32(1)
    share = np.float32(n / total) if total > 0 else zero
    for k in range(n):
        inverse = share
        if local:
            inverse = one / flux[k] if flux[k] > zero else zero
        has_light = one if inverse > zero else zero
        slopes[k] = slopes[k] * inverse - has_light * zero_points[k]
        slopes[n + k] = slopes[n + k] * inverse - has_light * zero_points[n + k]


class PyramidSlopes(FrameSlopes[PyramidPupils]):
    """Slope function of pupil images on a camera region.

    ``grid``: the pupil images; ``normalisation`` selects the divisor of the differences.

    Raises
    ------
    ValueError
        The pupil images extend beyond the region, or dark or flat have another shape.
    """

    def __init__(
        self,
        grid: PyramidPupils,
        shape: tuple[int, int],
        *,
        dark: NDArray[np.float32] | None = None,
        flat: NDArray[np.float32] | None = None,
    ) -> None:
        super().__init__(grid, shape, dark, flat)
        n = grid.valid.shape[0]
        if (grid.corners_px < 0).any() or (grid.corners_px + n > np.array(shape[::-1])).any():
            raise ValueError(f"the pupil images of {n} pixels leave the region {shape}")
        self._corners = (grid.corners_px[:, 1] * shape[1] + grid.corners_px[:, 0]).astype(np.uint64)
        self._runs = _runs(grid.valid, shape[1])
        self._zero_points = np.ascontiguousarray(grid.references.T, np.float32).ravel()
        self._local = grid.normalisation == "local"

    def _compute(
        self, frame: NDArray[np.uint16], slopes: NDArray[np.float32], light: NDArray[np.float32]
    ) -> None:
        quad_cell_slopes(
            frame, self._gain, self._offset, self._corners, self._runs, self._zero_points, self._local,
            slopes, light,
        )  # fmt: skip


def _runs(valid: NDArray[np.bool_], stride: int) -> NDArray[np.int64]:
    """Contiguous runs of valid pixels in each row, see :func:`quad_cell_slopes`."""
    edges = np.diff(np.pad(valid.astype(np.int8), ((0, 0), (1, 1))), axis=1)
    rows, starts = np.nonzero(edges == 1)
    ends = np.nonzero(edges == -1)[1]
    lengths = ends - starts
    first = np.concatenate([[0], np.cumsum(lengths)[:-1]])
    return np.stack([rows * stride + starts, lengths, first], axis=1).astype(np.int64)
