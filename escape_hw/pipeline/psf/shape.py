"""Width and encircled energy of an image of a point source."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from escape_hw.errors import CalibrationError
from escape_hw.pipeline.psf.strehl import find_peak, has_light, subtract_background

#: Directions in which the half maximum is searched, and step along each of them in pixels.
_DIRECTIONS, _STEP_PX = 72, 0.05
#: Parts into which a pixel is divided, along each axis, to find its share within a circle.
_SUBPIXELS = 4


@dataclass(frozen=True, slots=True)
class PsfShape:
    """Shape of an image, lengths in pixels.

    Parameters
    ----------
    row, column
        Sub-pixel position of the peak.
    peak, flux
        Brightest pixel, and sum of all, above the background, in counts.
    fwhm
        Full width at half maximum, mean over all directions.
    major, minor
        The same along the longest and the shortest diameter, from a fit of twice the angle.
    angle_deg
        Direction of the longest diameter from the columns towards the rows, -90 to 90 degrees.
    r50, r80
        Radii of 50 % and 80 % of the flux in the image.
    """

    row: float
    column: float
    peak: float
    flux: float
    fwhm: float
    major: float
    minor: float
    angle_deg: float
    r50: float
    r80: float


def measure_psf_shape(image: NDArray[np.number]) -> PsfShape:
    """Measure peak, widths and radii of encircled energy of an image ``(rows, columns)``.

    The background, the median of the border, is subtracted.

    Raises
    ------
    CalibrationError
        There is no light above the noise, or the peak is at the edge.
    """
    data = np.asarray(image, np.float64)
    if not has_light(data):
        raise CalibrationError("no light above the noise of the science camera")
    clean = subtract_background(data)
    row, column = (float(place) for place in find_peak(clean))
    flux = float(clean.sum())
    diameters, angles = _half_maximum_diameters(clean, row, column)
    ellipse = complex(2 * np.mean(diameters * np.exp(2j * angles)))
    mean = float(diameters.mean())
    radii, shares = encircled_energy(clean, (row, column))
    r50, r80 = (_radius_of_share(radii, shares, share) for share in (0.5, 0.8))
    return PsfShape(
        row, column, float(clean.max()), flux, mean, mean + abs(ellipse), mean - abs(ellipse),
        math.degrees(math.atan2(ellipse.imag, ellipse.real)) / 2, r50, r80,
    )  # fmt: skip


def _half_maximum_diameters(
    clean: NDArray[np.float64], row: float, column: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Diameter at half maximum by direction ``(n,)``, and the directions in radians.

    A cubic spline gives the maximum and the values along rays from it. A ray that stays above half of the
    maximum ends at the edge.
    """
    longest = min(row, column, clean.shape[0] - 1 - row, clean.shape[1] - 1 - column)
    spline = ndimage.spline_filter(clean)
    half = 0.5 * float(ndimage.map_coordinates(spline, [[row], [column]], prefilter=False)[0])
    angles = np.pi * np.arange(2 * _DIRECTIONS) / _DIRECTIONS
    # Most images are narrow: look near the peak first.
    for reach in (min(8.0, longest), longest):
        r = np.arange(0.0, reach + _STEP_PX, _STEP_PX)
        rays = row + np.outer(np.sin(angles), r), column + np.outer(np.cos(angles), r)
        values = ndimage.map_coordinates(spline, rays, prefilter=False, mode="nearest")
        below = values < half
        if below.any(axis=1).all():
            break
    first = np.where(below.any(axis=1), below.argmax(axis=1), r.size - 1)
    inner, outer = values[np.arange(len(values)), first - 1], values[np.arange(len(values)), first]
    drop = np.maximum(inner - outer, 1e-300)
    radius = r[first] - _STEP_PX * np.clip((half - outer) / drop, 0.0, 1.0)
    return radius[:_DIRECTIONS] + radius[_DIRECTIONS:], angles[:_DIRECTIONS]


def encircled_energy(
    clean: NDArray[np.floating], centre: tuple[float, float]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Share of the light within a circle, by radius.

    Parameters
    ----------
    clean
        Image without background ``(rows, columns)``.
    centre
        Centre of the circles (row, column).

    Returns
    -------
    radii, shares : ndarray
        Radii in steps of a quarter of a pixel up to the nearest edge ``(n,)``, and the shares ``(n,)``.
    """
    longest = min(
        centre[0] + 0.5, centre[1] + 0.5, clean.shape[0] - 0.5 - centre[0], clean.shape[1] - 0.5 - centre[1]
    )
    n = max(2, int(4 * longest) + 1)
    # Each pixel is spread evenly over parts, so that circles cut it.
    parts = (np.arange(_SUBPIXELS) - (_SUBPIXELS - 1) / 2) / _SUBPIXELS
    y, x = (np.arange(size)[:, None] + parts - c for size, c in zip(clean.shape, centre, strict=True))
    distance = np.hypot(y.reshape(-1, 1), x.reshape(1, -1))
    ring = np.minimum(np.ceil(4 * distance), n).astype(np.intp)
    light = np.repeat(np.repeat(clean, _SUBPIXELS, 0), _SUBPIXELS, 1) / _SUBPIXELS**2
    sums = np.bincount(ring.ravel(), weights=light.ravel(), minlength=n + 1)[:n]
    whole = float(clean.sum())
    return np.arange(n) / 4, np.cumsum(sums) / whole if whole else np.zeros(n)


def _radius_of_share(radii: NDArray[np.float64], shares: NDArray[np.float64], share: float) -> float:
    """Radius at which the share is reached first, interpolated; NaN if it is not."""
    beyond = int(np.argmax(shares >= share))
    if not shares[beyond] >= share:
        return math.nan
    low, high = (0.0, shares[0]) if beyond == 0 else (shares[beyond - 1], shares[beyond])
    return float(radii[beyond] - (radii[1] - radii[0]) * (high - share) / (high - low)) if high > low else 0.0
