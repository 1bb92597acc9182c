"""Reading of periodic screens between their pixels by cubic B-splines."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

#: Places between two pixels over which the power of a reading is averaged.
_PLACES = 64


def spline_weights(shift: NDArray[np.float64]) -> NDArray[np.float64]:
    """Weights ``(..., 4)`` of the coefficients at -1, 0, 1, 2 for a place ``0 <= shift < 1``."""
    w = np.asarray(shift)[..., None]
    return np.concatenate(
        [
            (1 - w) ** 3 / 6,
            (3 * w**3 - 6 * w**2 + 4) / 6,
            (1 + 3 * w + 3 * w**2 - 3 * w**3) / 6,
            w**3 / 6,
        ],
        axis=-1,
    )


def spline_gain(frequency: NDArray[np.floating]) -> NDArray[np.float64]:
    """Gain that a component of the coefficients needs for its readings to have its power.

    At the pixels a spline through given values reproduces them; between the pixels it loses power,
    all of it at the highest frequency midway. The gain makes the mean over all places right, which
    is what a screen that drifts past shows. Without it a spline would lose 3 % of the power at half
    the highest frequency (linear interpolation a third) and half of it at the highest.

    Parameters
    ----------
    frequency
        In cycles per pixel, any shape.
    """
    place = (np.arange(_PLACES) + 0.5) / _PLACES
    weights = spline_weights(place)
    turns = np.exp(2j * np.pi * np.asarray(frequency)[..., None] * np.arange(-1, 3))
    response = np.einsum("...k,pk->...p", turns, weights)
    return np.asarray(1 / np.sqrt(np.mean(np.abs(response) ** 2, axis=-1)))


@njit(cache=True, fastmath=True, nogil=True)
def read_two(one, two, share, column, row, along_x, along_y, first, last, line, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add ``share[0] x`` the reading of ``one`` and ``share[1] x`` that of ``two`` to ``out``.

    ``column`` and ``row`` are the pixels of the screens to the left of and above the first reading,
    ``along_x`` and ``along_y`` the four weights of the place between the pixels, the same for the
    whole pupil. Only columns ``first[i]..last[i]`` are touched; ``line`` is scratch.
    """
    mask = one.shape[0] - 1
    s, t = share[0], share[1]
    a0, a1, a2, a3 = s * along_y[0], s * along_y[1], s * along_y[2], s * along_y[3]
    b0, b1, b2, b3 = t * along_y[0], t * along_y[1], t * along_y[2], t * along_y[3]
    x0, x1, x2, x3 = along_x[0], along_x[1], along_x[2], along_x[3]
    for i in range(out.shape[0]):
        begin, end = first[i], last[i]
        if end <= begin:
            continue
        r0, r1 = (row + i - 1) & mask, (row + i) & mask
        r2, r3 = (row + i + 1) & mask, (row + i + 2) & mask
        start = (column - 1 + begin) & mask
        width = end - begin
        # Slices, for an index that could be negative keeps a loop from being vectorised.
        stop = start + width + 3
        p0, p1, p2, p3 = one[r0, start:stop], one[r1, start:stop], one[r2, start:stop], one[r3, start:stop]
        q0, q1, q2, q3 = two[r0, start:stop], two[r1, start:stop], two[r2, start:stop], two[r3, start:stop]
        target = out[i, begin:end]
        for j in range(width + 3):
            line[j] = a0 * p0[j] + a1 * p1[j] + a2 * p2[j] + a3 * p3[j]
        # More arrays in one loop are too many as well.
        for j in range(width + 3):
            line[j] += b0 * q0[j] + b1 * q1[j] + b2 * q2[j] + b3 * q3[j]
        for j in range(width):
            target[j] += x0 * line[j] + x1 * line[j + 1] + x2 * line[j + 2] + x3 * line[j + 3]
