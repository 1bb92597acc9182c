"""From OOPAO's images of single lenslets to the bench's camera, whose pixels do not match them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from escape_hw.pipeline.slopes import windows
from escape_sim.shack_hartmann import field_pixels, first_pixels

if TYPE_CHECKING:
    from escape_hw.api.sensor import SubApertureGrid

#: OOPAO's pixels per lambda/d here: critical sampling of an intensity.
SAMPLING = 2


def trigonometric_reading(at: NDArray[np.float64], period: int) -> NDArray[np.float64]:
    """Matrix that reads a band-limited periodic signal between its samples.

    An image of ``period / 2`` pupil samples holds frequencies below ``period / 2`` only, so
    ``period`` samples determine it everywhere and the reading is exact.

    Parameters
    ----------
    at
        Positions, in samples, any shape.
    period
        Number of samples, even.

    Returns
    -------
    ndarray, ``(*at.shape, period)``
    """
    top = period // 2 - 1
    turn = 2 * np.pi / period * (at[..., None] - np.arange(period))
    harmonics = np.arange(1, top + 1)
    return np.asarray((1 + 2 * np.cos(turn[..., None] * harmonics).sum(axis=-1)) / period)


def read_off(offset_px: NDArray[np.float64], n_pix: int, spot_px: float) -> NDArray[np.float64]:
    """Matrix from OOPAO's samples of a lenslet's image to camera pixels, along one axis.

    Parameters
    ----------
    offset_px
        Pixels relative to the lenslet's centre, any shape.
    n_pix
        Pupil samples across a lenslet.
    spot_px
        lambda/d in camera pixels.

    Returns
    -------
    ndarray, ``(*offset_px.shape, SAMPLING * n_pix)``
        Scaled so that a whole field holds the light of the lenslet.
    """
    period = SAMPLING * n_pix
    at = (period - 1) / 2 + offset_px * SAMPLING / spot_px
    return trigonometric_reading(at, period) * SAMPLING / spot_px


@dataclass(frozen=True, slots=True, eq=False)
class Levers:
    """Weights on OOPAO's samples of what each window sees of one lenslet.

    Parameters
    ----------
    lenslet
        Number of that lenslet among the lit ones ``(n_valid,)``; any where the weights are 0.
    along_x, along_y
        Weights of the window's sum and of its first moment about its own lenslet's centre,
        ``(n_valid, samples, 2)``.
    """

    lenslet: NDArray[np.intp]
    along_x: NDArray[np.float64]
    along_y: NDArray[np.float64]


def window_levers(
    grid: SubApertureGrid, lit: NDArray[np.bool_], shape: tuple[int, int], n_pix: int, spot_px: float
) -> list[Levers]:
    """Weights of every valid window on its own lenslet and on the eight around it.

    Parameters
    ----------
    grid
        The sub-aperture grid.
    lit
        Lenslets that carry light, in whose order OOPAO delivers images ``(n_sub, n_sub)``.
    shape
        Camera region (rows, columns).
    n_pix
        Pupil samples across a lenslet.
    spot_px
        lambda/d in camera pixels.
    """
    n_sub = lit.shape[0]
    number = np.where(lit, np.cumsum(lit).reshape(lit.shape) - 1, -1)
    rows, columns = np.nonzero(grid.valid)
    top, end, left, right = windows(grid.centres_px(), grid.pitch_px, shape).T

    def along(
        origin: float, own: NDArray[np.intp], low: NDArray[np.int32], high: NDArray[np.int32], step: int
    ) -> NDArray[np.float64]:
        centres = np.asarray(origin + np.arange(n_sub) * grid.pitch_px, dtype=np.float64)
        other = np.clip(own + step, 0, n_sub - 1)
        size = field_pixels(n_pix, spot_px)
        first = first_pixels(centres, size)[other]
        pixels = low[:, None] + np.arange(int((high - low).max()))
        read = read_off(pixels - centres[other, None], n_pix, spot_px)
        seen = (pixels < high[:, None]) & (pixels >= first[:, None]) & (pixels < first[:, None] + size)
        read[~seen] = 0.0
        lever = (pixels - centres[own, None])[..., None]
        return np.stack([read.sum(axis=1), (lever * read).sum(axis=1)], axis=2)

    out = []
    for down in (-1, 0, 1):
        for aside in (-1, 0, 1):
            i, j = rows + down, columns + aside
            inside = (i >= 0) & (i < n_sub) & (j >= 0) & (j < n_sub)
            lenslet = np.where(inside, number[np.clip(i, 0, n_sub - 1), np.clip(j, 0, n_sub - 1)], -1)
            x = along(grid.origin_px[0], columns, left, right, aside)
            y = along(grid.origin_px[1], rows, top, end, down)
            x[lenslet < 0] = 0.0
            out.append(Levers(np.maximum(lenslet, 0), x, y))
    return out
