"""The pupil's centre from the shadow of what stands in it: the secondary mirror and its vanes."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from escape_hw.pipeline.rims import SOFT

if TYPE_CHECKING:
    from escape_hw.config.telescope_models import TelescopeSection

#: Points along each side of a sample at which it is asked whether light passes.
_POINTS = 8
#: Share of the radius in which the shadow is looked for: farther out the rim's own troubles begin.
_INSIDE = 0.5
#: Highest power of the smooth light that the shadow falls on.
_SMOOTH = 2
_ITERATIONS, _LARGEST, _DIFFERENCE = 4, 0.7, 0.25
#: What light that is uneven on the scale of the shadow moves it by in all four images alike, in pixels: their
#: scatter does not know (docs/decisions/0018-pyramids-in-truth.md).
_COMMON_PX = 0.05
#: Finer than that by so much where the shadow is moved by fractions of a pixel.
_FINER = 3

#: Share of the light that passes at coordinates ``(n,)`` along x and ``(m,)`` along y, in pupil diameters.
Shadow = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]


def passed_share(
    telescope: TelescopeSection,
    diameter_m: float,
    x_m: NDArray[np.float64],
    y_m: NDArray[np.float64] | None = None,
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
    """
    x, y = _finely(x_m, diameter_m)[None, :], _finely(x_m if y_m is None else y_m, diameter_m)[:, None]
    passed = np.hypot(x, y) >= telescope.obscuration * diameter_m / 2
    for angle in np.deg2rad(telescope.spiders_deg):
        along, across = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
        passed &= (along < 0) | (np.abs(across) > telescope.spider_m / 2)
    return np.asarray(passed.reshape(y.size // _POINTS, _POINTS, -1, _POINTS).mean(axis=(1, 3)))


def _finely(at: NDArray[np.float64], alone: float) -> NDArray[np.float64]:
    step = at[1] - at[0] if at.size > 1 else alone
    inside = ((np.arange(_POINTS) + 0.5) / _POINTS - 0.5) * step
    return np.asarray((at[:, None] + inside).ravel())


def shadow_of(telescope: TelescopeSection) -> Shadow | None:
    """The shadow of a telescope's obscuration and vanes; ``None`` if it has neither."""
    if not telescope.obscuration:
        return None

    def shadow(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        # With points further apart the edge is a staircase to those who move it by fractions of a pixel.
        step = x[1] - x[0]
        fine = ((np.arange(_FINER) + 0.5) / _FINER - 0.5) * step
        share = passed_share(telescope, 1.0, *((at[:, None] + fine).ravel() for at in (x, y)))
        return np.asarray(share.reshape(y.size, _FINER, x.size, _FINER).mean(axis=(1, 3)))

    return shadow


def shadow_offset(
    image: NDArray[np.float64], centres: NDArray[np.float64], diameter: float, shadow: Shadow
) -> tuple[NDArray[np.float64], float]:
    """How far the shadow lies beside the centres of the images, in common, and with what error.

    Within each image the light is taken for a polynomial of second degree, from which the shadow
    takes a share; all of it is linear but for the shadow's place, which the four images share.

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
        Standard error along an axis, by the scatter of the four and what they have in common.
    """
    offset = np.zeros(2)
    moves = np.zeros((4, 2))
    for _ in range(_ITERATIONS):
        moves = np.array([_step(image, at, diameter, shadow) for at in centres + offset])
        offset += np.clip(moves.mean(axis=0), -_LARGEST, _LARGEST)
    scatter = float(np.mean(np.var(moves, axis=0, ddof=1))) / len(moves)
    return offset, float(np.hypot(np.sqrt(scatter), _COMMON_PX))


def _step(
    image: NDArray[np.float64], centre: NDArray[np.float64], diameter: float, shadow: Shadow
) -> NDArray[np.float64]:
    """Gauss-Newton step ``(2,)`` of the shadow in one image."""
    reach = int(np.ceil(_INSIDE * diameter / 2)) + 1
    columns, rows = (round(at) + np.arange(-reach, reach + 1) for at in centre)
    x, y = (columns - centre[0]) / diameter, (rows - centre[1]) / diameter

    def shade(dx: float, dy: float) -> NDArray[np.float64]:
        covered = 1 - shadow(x - dx / diameter, y - dy / diameter)
        return np.asarray(ndimage.gaussian_filter(covered, SOFT, mode="nearest"))

    e = _DIFFERENCE
    moving = [(shade(e, 0) - shade(-e, 0)) / (2 * e), (shade(0, e) - shade(0, -e)) / (2 * e)]
    u, v = np.meshgrid(2 * x, 2 * y)
    inside = np.hypot(u, v) < _INSIDE
    powers = [(i, j) for i in range(_SMOOTH + 1) for j in range(_SMOOTH + 1 - i)]
    smooth = [u**i * v**j for i, j in powers]
    light = image[np.ix_(rows, columns)][inside]
    known = np.stack([term[inside] for term in (*smooth, shade(0, 0))], axis=1)
    depth = np.linalg.lstsq(known, light, rcond=None)[0][-1]
    by_place = np.stack([depth * term[inside] for term in moving], axis=1)
    return np.asarray(np.linalg.lstsq(np.concatenate([known, by_place], axis=1), light, rcond=None)[0][-2:])
