"""Centre of the pupil from the shadow of the secondary mirror and its vanes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from escape_hw.config.system import TelescopeSection
from escape_hw.pipeline.geometry.pupil_rims import RIM_SOFTNESS

#: Points along each side of a sample at which the transmission is evaluated.
_POINTS = 8
#: Share of the radius in which the shadow is fitted, away from the rim.
_FIT_RADIUS = 0.8
#: Degree of the polynomial of the light; with a lower one uneven light is taken for a shift of the shadow.
_POLYNOMIAL_DEGREE = 6
#: Number of iterations, and largest step of each in pixels.
_ITERATIONS, _MAX_STEP = 4, 0.7
#: Samples across a pixel of the shadow map (odd), and points along each side of a sample.
_OVERSAMPLING, _COARSE_POINTS = 21, 2
#: Transmission ``(m, n)`` at coordinates ``(n,)`` along x and ``(m,)`` along y, in pupil diameters.
Shadow = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]


def transmitted_fraction(
    telescope: TelescopeSection,
    diameter_m: float,
    x_m: NDArray[np.float64],
    y_m: NDArray[np.float64] | None = None,
    points: int = _POINTS,
) -> NDArray[np.float64]:
    """Fraction of each sample that is not covered by the central obscuration or a vane ``(n_y, n_x)``.

    Parameters
    ----------
    x_m, y_m
        Coordinates of the samples along either axis in metres, evenly spaced; ``y_m`` as ``x_m`` by
        default.
    points
        Points along each side of a sample.
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
    """Build the transmission of a telescope's obscuration and vanes; ``None`` without an obscuration."""
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
    """Fit the common offset of the shadow from the centres of the images.

    The model of the light in each image is a polynomial of sixth degree times the transmission, linear in all
    but the offset, which the four images share. The light is not compressed, because unevenness would not
    remain smooth.

    Parameters
    ----------
    image
        Light ``(rows, columns)``, background subtracted.
    centres
        Centres of the images ``(4, 2)`` as (x, y).
    diameter
        Their diameter in pixels.
    shadow
        Transmission from :func:`build_shadow`.

    Returns
    -------
    offset : ndarray, ``(2,)``
        As (x, y) in pixels.
    sigma : float
        Standard error along an axis by the scatter of the four images, without their common errors.
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
    """Half width in pixels of the box in which the shadow is fitted."""
    return int(np.ceil(_FIT_RADIUS * diameter / 2)) + 1


def _shadow_map(shadow: Shadow, diameter: float) -> NDArray[np.float64]:
    """Map ``(3, n, n)`` of the light that a pixel loses, and of its derivatives with respect to the offset.

    As a function of the position of the pixel from the shadow's centre, with :data:`_OVERSAMPLING` samples
    per pixel.
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
    """Gauss-Newton step ``(2,)`` of the offset in one image."""
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
        # The lost light is proportional to the light.
        *coefficients, depth = np.linalg.lstsq(np.column_stack([smooth, lit * dark]), light, rcond=None)[0]
        before, lit = lit, smooth @ coefficients
    terms = np.column_stack([smooth, before * dark, *(depth * before * part for part in moving)])
    return np.asarray(np.linalg.lstsq(terms, light, rcond=None)[0][-2:])
