"""Fit of the rims of pupil images, with a brightness that varies along the rim."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import special

from escape_hw.pipeline.statistics import root_mean_square

#: Softness of a rim in pixels (rms): the width of a pixel and diffraction.
RIM_SOFTNESS = 0.45
#: Half width in pixels of the ring in which a rim is fitted, and harmonics of its brightness.
_RING, _HARMONICS = 4.0, 6
#: Iterations, and how many of the last ones use the narrow ring.
ITERATIONS, _NARROW_ITERATIONS = 12, 8
#: Largest step of a parameter per iteration, in pixels.
_MAX_STEP = 1.5
#: Distance in pixels from the rim of another image within which pixels are left out.
_NEIGHBOUR_MARGIN = 2.0
#: Highest harmonic of a rim's radius that is fitted.
MAX_HARMONIC = 4


def fit_rims(
    image: NDArray[np.float64],
    rough: NDArray[np.float64],
    radius: float,
    nominal: float,
    iterations: int = ITERATIONS,
    order: int = 1,
) -> tuple[NDArray[np.float64], float]:
    """Fit centres ``(4, 2)`` and common radius of the images to their rims.

    Parameters
    ----------
    image
        Light ``(rows, columns)``, background subtracted.
    rough
        Centres ``(4, 2)`` to start from.
    radius, nominal
        Radius to start from, and radius of the design, in pixels.
    iterations
        Number of iterations; the last ones use a narrow ring.
    order
        Highest harmonic of the radius that is fitted: 1 for a circle, more for rims that are out of round.
    """
    centres = rough.copy()
    for iterations_left in reversed(range(iterations)):
        # A wide ring captures, a narrow one is precise.
        width = min(_RING * (1 if iterations_left < _NARROW_ITERATIONS else 2), nominal / 2)
        moves = [
            _rim_step(image, centres, k, radius, width, nominal + _NEIGHBOUR_MARGIN, order) for k in range(4)
        ]
        limited = np.clip(moves, -_MAX_STEP, _MAX_STEP)
        centres += limited[:, 1:3]
        radius = max(radius + float(np.median(limited[:, 0])), nominal / 2)
    return centres, radius


def _rim_step(
    image: NDArray[np.float64],
    centres: NDArray[np.float64],
    number: int,
    radius: float,
    width: float,
    min_distance: float,
    order: int = 1,
) -> NDArray[np.float64]:
    """Gauss-Newton step ``(2 order + 1,)`` of one image's radius, centre (x, y) and higher harmonics.

    The model of the light in a ring around the rim is ``outside(angle) + inside(angle, depth) * edge``,
    linear in all but the position of the edge. Pixels within ``min_distance`` of another image's centre are
    left out.
    """
    x, y = centres[number]
    pixels, light = _ring_pixels(image, x, y, radius, width)
    others = np.delete(centres, number, axis=0)
    isolated = np.hypot(*(pixels[:, None] - others.T[:, :, None])).min(axis=0) > min_distance
    (dx, dy), light = pixels[:, isolated] - centres[number][:, None], light[isolated]
    r = np.hypot(dx, dy)
    # Fewer harmonics for rims of few pixels.
    waves = _harmonics(np.arctan2(dy, dx), min(_HARMONICS, int(radius // 3)))
    depth = (radius - r) / RIM_SOFTNESS
    edge = special.ndtr(depth)
    steepness = np.exp(-(depth**2) / 2) / (np.sqrt(2 * np.pi) * RIM_SOFTNESS)
    slant = (depth * edge)[:, None] * waves[:, :5]
    known = np.concatenate([waves, waves * edge[:, None], slant], axis=1)
    coefficients = _least_squares(known, light)
    n = waves.shape[1]
    bright = (waves @ coefficients[n : 2 * n]) * steepness
    moving = bright[:, None] * _harmonics(np.arctan2(dy, dx), order)
    return _least_squares(np.concatenate([known, moving], axis=1), light)[-(2 * order + 1) :]


def estimate_roundness_error(
    image: NDArray[np.float64], centres: NDArray[np.float64], radius: float, nominal: float
) -> float:
    """Estimate the error of the images' common shift by the roundness of their rims, in pixels (rms).

    Vignetting at the rim of the pupil is the same in all four images and does not average out. Its first
    harmonic, which is taken for a shift, is assumed to be as large as the second to fourth ones, which are
    measured.

    ``image``, ``nominal``: as for :func:`fit_rims`; ``centres``, ``radius``: result of :func:`fit_rims`.
    """
    width = min(_RING, nominal / 2)
    steps = [
        _rim_step(image, centres, k, radius, width, nominal + _NEIGHBOUR_MARGIN, MAX_HARMONIC)
        for k in range(4)
    ]
    return root_mean_square(np.mean(steps, axis=0)[3:])


def _least_squares(terms: NDArray[np.float64], light: NDArray[np.float64]) -> NDArray[np.float64]:
    """Coefficients of the terms, by the normal equations."""
    scale = np.sqrt(np.maximum(np.square(terms).sum(axis=0), 1e-30))
    unit = terms / scale
    return np.asarray(np.linalg.lstsq(unit.T @ unit, unit.T @ light, rcond=1e-12)[0] / scale)


def _harmonics(angle: NDArray[np.float64], order: int) -> NDArray[np.float64]:
    """1, cos a, sin a, cos 2a, ... as columns."""
    turns = angle[:, None] * np.arange(1, order + 1)
    both = np.stack([np.cos(turns), np.sin(turns)], axis=2).reshape(angle.size, -1)
    return np.concatenate([np.ones((angle.size, 1)), both], axis=1)


def _ring_pixels(
    image: NDArray[np.float64], x: float, y: float, radius: float, width: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Positions ``(2, n)`` as (x, y) and light ``(n,)`` of the pixels around a rim."""
    reach = int(np.ceil(radius + width)) + 1
    columns, rows = np.meshgrid(
        round(x) + np.arange(-reach, reach + 1), round(y) + np.arange(-reach, reach + 1)
    )
    near = np.abs(np.hypot(columns - x, rows - y) - radius) <= width
    columns, rows = columns[near], rows[near]
    seen = (columns >= 0) & (columns < image.shape[1]) & (rows >= 0) & (rows < image.shape[0])
    light = np.zeros(columns.size)
    light[seen] = image[rows[seen], columns[seen]]
    return np.stack([columns, rows]).astype(float), light
