"""The pupil's centre from the shadow of what stands in it: the secondary mirror and its vanes."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from escape_hw.pipeline.geometry.pupil_rims import RIM_SOFTNESS

if TYPE_CHECKING:
    from escape_hw.config.system import TelescopeSection

#: Points along each side of a sample at which it is asked whether light passes.
_POINTS = 8
#: Share of the radius in which the shadow is looked for: farther out the rim's own troubles begin.
_FIT_RADIUS = 0.8
#: Highest power of the smooth light that the shadow falls on: less takes uneven light for a moved shadow.
_POLYNOMIAL_DEGREE = 6
#: Steps to where the shadow is, and the largest of them in pixels.
_ITERATIONS, _MAX_STEP = 4, 0.7
#: Samples across a pixel of the shadow's map, an odd number, and points along each side of such a sample.
_OVERSAMPLING, _COARSE_POINTS = 21, 2
#: Share of the light that passes at coordinates ``(n,)`` along x and ``(m,)`` along y, in pupil diameters.
Shadow = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]


def transmitted_fraction(
    telescope: TelescopeSection,
    diameter_m: float,
    x_m: NDArray[np.float64],
    y_m: NDArray[np.float64] | None = None,
    points: int = _POINTS,
) -> NDArray[np.float64]:
    """Share of each sample that neither the central obscuration nor a vane covers ``(n_y, n_x)``.

    Parameters
    ----------
    telescope
        Obscuration and vanes.
    diameter_m
        Diameter of the pupil in metres.
    x_m, y_m
        Coordinates of the samples along either axis in metres, evenly spaced; ``y_m`` as ``x_m`` by
        default.
    points
        Points along each side of a sample at which it is asked whether light passes.
    """
    x, y = (_subsample(at, diameter_m, points) for at in (x_m, x_m if y_m is None else y_m))
    x, y = x[None, :], y[:, None]
    passed = np.hypot(x, y) >= telescope.obscuration * diameter_m / 2
    for angle in np.deg2rad(telescope.spiders_deg):
        along, across = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
        passed &= (along < 0) | (np.abs(across) > telescope.spider_m / 2)
    return np.asarray(passed.reshape(y.size // points, points, -1, points).mean(axis=(1, 3)))


def _subsample(at: NDArray[np.float64], alone: float, points: int) -> NDArray[np.float64]:
    step = at[1] - at[0] if at.size > 1 else alone
    inside = ((np.arange(points) + 0.5) / points - 0.5) * step
    return np.asarray((at[:, None] + inside).ravel())


def build_shadow(telescope: TelescopeSection, diameter_m: float) -> Shadow | None:
    """The shadow of a telescope's obscuration and vanes; ``None`` if it has no obscuration.

    Parameters
    ----------
    telescope
        Obscuration and vanes.
    diameter_m
        Diameter of the pupil in metres, which the vanes' width is told in.
    """
    if not telescope.obscuration:
        return None

    def shadow(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        return transmitted_fraction(
            telescope, diameter_m, x * diameter_m, y * diameter_m, points=_COARSE_POINTS
        )

    return shadow


def fit_shadow_offset(
    image: NDArray[np.float64], centres: NDArray[np.float64], diameter: float, shadow: Shadow
) -> tuple[NDArray[np.float64], float]:
    """How far the shadow lies beside the centres of the images, in common, and with what error.

    Within each image the light is taken for a polynomial of sixth degree, from which the shadow
    takes a share; all of it is linear but for the shadow's place, which the four images share. The light
    as it is counts: pressed down, what is uneven from image to image would no longer be smooth.

    Parameters
    ----------
    image
        Light ``(rows, columns)``, background subtracted.
    centres
        Centres of the images ``(4, 2)`` as (x, y).
    diameter
        Their diameter in pixels.
    shadow
        What passes.

    Returns
    -------
    offset : ndarray, ``(2,)``
        As (x, y) in pixels.
    sigma : float
        Standard error along an axis by the scatter of the four. It does not know what they err by in
        common; and what takes light from one image and gives it to another counts twice in it.
    """
    offset = np.zeros(2)
    moves = np.zeros((4, 2))
    shadow_map = _shadow_map(shadow, diameter)
    for _ in range(_ITERATIONS):
        moves = np.array([_gauss_newton_step(image, at, diameter, shadow_map) for at in centres + offset])
        offset += np.clip(moves.mean(axis=0), -_MAX_STEP, _MAX_STEP)
    scatter = float(np.mean(np.var(moves, axis=0, ddof=1))) / len(moves)
    return offset, float(np.sqrt(scatter))


def _reach(diameter: float) -> int:
    """Pixels from the centre to beyond where the shadow is looked for."""
    return int(np.ceil(_FIT_RADIUS * diameter / 2)) + 1


def _shadow_map(shadow: Shadow, diameter: float) -> NDArray[np.float64]:
    """Map ``(3, n, n)`` of what a pixel lacks for the shadow, and its derivatives by the shadow's place.

    By where the pixel's middle lies from the shadow's centre, :data:`_OVERSAMPLING` samples to a pixel.
    """
    half = (_reach(diameter) + 1) * _OVERSAMPLING
    at = np.arange(-half, half + 1) / (_OVERSAMPLING * diameter)
    covered = ndimage.gaussian_filter(1 - shadow(at, at), RIM_SOFTNESS * _OVERSAMPLING, mode="nearest")
    seen = ndimage.uniform_filter(covered, _OVERSAMPLING, mode="nearest")
    by_y, by_x = np.gradient(seen, 1 / _OVERSAMPLING)
    return np.stack([seen, -by_x, -by_y])


def _gauss_newton_step(
    image: NDArray[np.float64], centre: NDArray[np.float64], diameter: float, shadow_map: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Gauss-Newton step ``(2,)`` of the shadow in one image."""
    reach = _reach(diameter)
    columns, rows = (round(at) + np.arange(-reach, reach + 1) for at in centre)
    x, y = np.meshgrid(columns - centre[0], rows - centre[1])
    u, v = 2 * x / diameter, 2 * y / diameter
    inside = np.hypot(u, v) < _FIT_RADIUS
    powers = [(i, j) for i in range(_POLYNOMIAL_DEGREE + 1) for j in range(_POLYNOMIAL_DEGREE + 1 - i)]
    smooth = np.stack([u[inside] ** i * v[inside] ** j for i, j in powers], axis=1)
    places = np.stack([y[inside], x[inside]]) * _OVERSAMPLING + shadow_map.shape[1] // 2
    dark, *moving = (ndimage.map_coordinates(part, places, order=1) for part in shadow_map)
    light = image[np.ix_(rows, columns)][inside]
    lit, depth = np.ones_like(light), 0.0
    for _ in range(2):
        # The shadow takes its share of whatever light there is.
        *coefficients, depth = np.linalg.lstsq(np.column_stack([smooth, lit * dark]), light, rcond=None)[0]
        before, lit = lit, smooth @ coefficients
    terms = np.column_stack([smooth, before * dark, *(depth * before * part for part in moving)])
    return np.asarray(np.linalg.lstsq(terms, light, rcond=None)[0][-2:])
