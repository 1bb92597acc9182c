"""The rims of pupil images: where the light ends, whatever its brightness along the way."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import special

#: Softness of a rim in pixels (rms): a pixel's own width and a little diffraction.
RIM_SOFTNESS = 0.45
#: Half width in pixels of the ring in which a rim is fitted, and harmonics of its brightness.
_RING, _HARMONICS = 4.0, 6
#: Iterations, and how many of the last with a narrow ring.
ITERATIONS, _NARROW_ITERATIONS = 12, 8
#: Pixels that come so near to another image (in pixels from its rim) are left out.
_NEIGHBOUR_MARGIN = 2.0
#: Harmonics of a rim's radius that are told apart.
MAX_HARMONIC = 4


def fit_rims(
    image: NDArray[np.float64],
    rough: NDArray[np.float64],
    radius: float,
    nominal: float,
    iterations: int = ITERATIONS,
    order: int = 1,
) -> tuple[NDArray[np.float64], float]:
    """Centres ``(4, 2)`` and the common radius of the images, from their rims alone.

    Parameters
    ----------
    image
        Light ``(rows, columns)``, background subtracted.
    rough
        Centres ``(4, 2)`` to start from.
    radius, nominal
        Radius to start from, and that of the design, in pixels.
    iterations
        How many; at the end of them the ring is narrow.
    order
        Harmonics of the radius that are fitted beside: 1 is a circle, more let the rim be out of round.
    """
    centres = rough.copy()
    for iterations_left in reversed(range(iterations)):
        # A wide ring captures, a narrow one is precise.
        width = min(_RING * (1 if iterations_left < _NARROW_ITERATIONS else 2), nominal / 2)
        moves = [
            _rim_step(image, centres, k, radius, width, nominal + _NEIGHBOUR_MARGIN, order) for k in range(4)
        ]
        limited = np.clip(moves, -1.5, 1.5)
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

    In a ring around the rim the light is taken for ``outside(angle) + inside(angle, depth) * edge``,
    all of which is linear but for the edge's place. Pixels ``min_distance`` or less from another image's
    centre are left out.
    """
    x, y = centres[number]
    pixels, light = _ring_pixels(image, x, y, radius, width)
    others = np.delete(centres, number, axis=0)
    isolated = np.hypot(*(pixels[:, None] - others.T[:, :, None])).min(axis=0) > min_distance
    (dx, dy), light = pixels[:, isolated] - centres[number][:, None], light[isolated]
    r = np.hypot(dx, dy)
    # A rim of few pixels tells few harmonics.
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
    """How far the first harmonic of the images' common rim may lie off its true place, in pixels (rms).

    What eats into the rim of a pupil does so in all four images alike and no frames average it out. A
    rim that is out of round by so much in the second to fourth harmonic is so in the first as well,
    where it passes for a shift.

    Parameters
    ----------
    image, centres, radius, nominal
        As for :func:`fit_rims`, and what it found.
    """
    width = min(_RING, nominal / 2)
    steps = [
        _rim_step(image, centres, k, radius, width, nominal + _NEIGHBOUR_MARGIN, MAX_HARMONIC)
        for k in range(4)
    ]
    return float(np.sqrt(np.mean(np.square(np.mean(steps, axis=0)[3:]))))


def _least_squares(terms: NDArray[np.float64], light: NDArray[np.float64]) -> NDArray[np.float64]:
    """Shares of the terms in the light, by the normal equations: few terms, many pixels."""
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
    """Places ``(2, n)`` as (x, y) and light ``(n,)`` of the pixels around a rim; outside it is dark."""
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
