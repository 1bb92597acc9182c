"""Geometry of a pyramid sensor as found on its camera."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.representation import short_repr
from escape_hw.api.sensor import SensorGeometry

#: Names of the four pupil images in the order used everywhere: ``2 * lower + right``.
IMAGES = ("upper left", "upper right", "lower left", "lower right")

#: Share of the radius inside which no pixel is cut by the rim of an image.
_INNER_RADIUS = 0.9


@dataclass(frozen=True, slots=True, eq=False)
class PyramidPupils(SensorGeometry):
    """The four pupil images on the camera.

    The slopes of a pixel of the pupil are, with the light U (upper) or L (lower), left L or right R
    at the same pixel of the four images, minus references (Ragazzoni 1996),

        sx = (UR + LR - UL - LL) / norm        sy = (LL + LR - UL - UR) / norm

    where ``norm`` is the mean over all valid pixels of the sum of the four (``global``), or that
    pixel's own sum (``local``).

    Parameters
    ----------
    centres_px
        Centres of the images ``(4, 2)`` as (x, y) in pixels of the region read, pixel centres at
        whole numbers, in the order of :data:`IMAGES`.
    diameter_px
        Diameter of an image in pixels.
    corners_px
        First pixel ``(4, 2)`` as (x, y) of the box of n x n pixels around each image; the centre of
        a box lies within half a pixel of the centre of its image.
    valid
        Valid pixels, boolean ``(n, n)``.
    references
        Slopes of the flat wavefront ``(n_valid, 2)`` as (x, y).
    flux
        Light of every pixel, summed over the images, relative to a bright one ``(n, n)``.
    counts
        Counts per frame of a bright pixel, summed over the images; 0 if unknown.
    motion
        Rms of the slopes over time during the measurement that a model of this sensor is to match.
    background
        Level of the dark pixels in counts that was subtracted when no dark frame was at hand.
    normalisation
        ``"global"`` or ``"local"``.
    modulation
        Radius of the modulation in lambda/D during the measurement.
    centre_sigma_px
        Standard error of the mean of the four centres along an axis; 0 if unknown. A mirror's shift
        counts from there.
    pokes
        Rms surface over the pupil of the random pokes during the measurement, all modes together, as
        fraction of full stroke: what the sensor answers depends on them as it does on the turbulence.
    looks
        Independent states of the air that the measurement saw; 0 if unknown.
    steady
        Share of the slopes' variance that is still there two frames later: the air's, not the pokes'.
    """

    kind: ClassVar[str] = "pyramid"
    slope_unit: ClassVar[str] = "1"
    elements: ClassVar[str] = "pupil pixels"
    short_run_note: ClassVar[str] = (
        "the centres of the pupil images were found in {seconds:.1f} s of turbulence, which may leave them "
        "some hundredths of a pixel off; the shifts of the registration, which refer to them, are so too"
    )

    centres_px: NDArray[np.float64]
    diameter_px: float
    corners_px: NDArray[np.intp]
    valid: NDArray[np.bool_]
    references: NDArray[np.float32]
    flux: NDArray[np.float32]
    counts: float = 0.0
    motion: float = 0.0
    background: float = 0.0
    normalisation: str = "global"
    modulation: float = 0.0
    centre_sigma_px: float = 0.0
    pokes: float = 0.0
    n_effective: float = 0.0
    persistent_fraction: float = 0.0
    __repr__ = short_repr

    def with_background(self, counts: float) -> PyramidPupils:
        """See :meth:`SensorGeometry.with_background`."""
        return replace(self, background=counts)

    def with_slope_statistics(
        self, rms: float, pokes: float = 0.0, n_effective: float = 0.0, persistent_fraction: float = 0.0
    ) -> PyramidPupils:
        """See :meth:`SensorGeometry.with_slope_statistics`."""
        return replace(
            self, motion=rms, pokes=pokes, n_effective=n_effective, persistent_fraction=persistent_fraction
        )

    def with_mean_slopes(self, mean: NDArray[np.float64]) -> PyramidPupils:
        """See :meth:`SensorGeometry.with_mean_slopes`; of the mean only what is not smooth counts."""
        new_references = self.references + remove_low_orders(mean.reshape(2, -1).T, self.valid, self.flux)
        return replace(self, references=new_references.astype(np.float32))


def remove_low_orders(
    slopes: NDArray[np.float64], valid: NDArray[np.bool_], flux: NDArray[np.float32]
) -> NDArray[np.float64]:
    """Mean slopes under turbulence, less the smooth part that may be the turbulence's own.

    What a mean over seconds still holds of the turbulence is tilt, focus, astigmatism and coma: its
    slopes are polynomials of the second degree over the pupil, which are fitted where the light is
    full and taken off everywhere. What remains belongs to the instrument: unequal faces and pixels,
    and above all the rims of the four images, which fall on the pixels differently. A flat wavefront
    has no smooth slopes on a pyramid whose tip is on the beam's axis, so nothing is lost.

    Parameters
    ----------
    slopes
        ``(n_valid, 2)`` as (x, y).
    valid, flux
        Of the pupils, ``(n, n)``.
    """
    n = valid.shape[0]
    rows, columns = np.nonzero(valid)
    x, y = (2 * columns - (n - 1)) / n, (2 * rows - (n - 1)) / n
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
    inner = x * x + y * y < _INNER_RADIUS**2
    weight = np.sqrt(np.maximum(flux[valid], 0.0))[inner, None]
    coefficients = np.linalg.lstsq(terms[inner] * weight, slopes[inner] * weight, rcond=None)[0]
    return np.asarray(slopes - terms @ coefficients)


def pupil_boxes(centres_px: NDArray[np.float64], n: int) -> NDArray[np.intp]:
    """First pixels ``(4, 2)`` as (x, y) of boxes of n x n pixels whose centres come nearest."""
    return np.rint(np.asarray(centres_px) - (n - 1) / 2).astype(np.intp)
