"""Geometry of a Shack-Hartmann sensor as found on its camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, eq=False)
class SubApertureGrid:
    """The lenslet grid on the camera, found from frames.

    The centre of lenslet ``(i, j)`` (row, column) lies at ``origin + (j, i) * pitch`` pixels of
    the region read, x along columns and y along rows, pixel centres at whole numbers.

    Parameters
    ----------
    pitch_px
        Lenslet pitch in camera pixels (need not be whole).
    origin_px
        Centre of lenslet (0, 0) as (x, y) in pixels.
    valid
        Valid sub-apertures, boolean ``(n_rows, n_columns)``.
    references_px
        Reference spot positions ``(n_valid, 2)`` as (x, y) relative to the lenslet centres.
    flux
        Flux of every sub-aperture relative to a bright one, ``(n_rows, n_columns)``.
    counts
        Counts per frame of a bright sub-aperture (the 95th percentile of those lit); 0 if unknown.
    motion_px
        Rms motion of the spots along an axis, in pixels, during the measurement that a model of
        this sensor is to match.
    background
        Level of the dark pixels in counts that was subtracted when no dark frame was at hand.
    """

    pitch_px: float
    origin_px: tuple[float, float]
    valid: NDArray[np.bool_]
    references_px: NDArray[np.float32]
    flux: NDArray[np.float32]
    counts: float = 0.0
    motion_px: float = 0.0
    background: float = 0.0

    @property
    def n_valid(self) -> int:
        """Number of valid sub-apertures."""
        return int(self.valid.sum())

    @property
    def n_slopes(self) -> int:
        """Number of slopes: all x, then all y, over the valid sub-apertures in row-major order."""
        return 2 * self.n_valid

    def centres_px(self) -> NDArray[np.float64]:
        """Centres ``(n_valid, 2)`` of the valid lenslets as (x, y) in pixels."""
        rows, columns = np.nonzero(self.valid)
        return np.stack(
            [self.origin_px[0] + columns * self.pitch_px, self.origin_px[1] + rows * self.pitch_px], axis=1
        )
