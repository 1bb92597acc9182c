"""What stands in the light before the pupil, and what lies on it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from escape_hw.config.telescope_models import TelescopeSection
    from escape_hw.config.twin_sky import TwinContamination

#: Points along each side of a sample at which it is asked whether light passes.
_POINTS = 8
#: Highest order of the smooth unevenness: waves across the pupil, or around its edge.
_WAVES = 5


def passed_share(
    telescope: TelescopeSection, diameter_m: float, coordinates_m: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Share of each sample that neither the central obscuration nor a vane covers ``(n, n)``.

    Parameters
    ----------
    telescope
        Obscuration and vanes.
    diameter_m
        Diameter of the pupil in metres.
    coordinates_m
        Coordinates of the samples along either axis ``(n,)`` in metres.
    """
    n = coordinates_m.size
    step = coordinates_m[1] - coordinates_m[0] if n > 1 else diameter_m
    inside = ((np.arange(_POINTS) + 0.5) / _POINTS - 0.5) * step
    fine = (coordinates_m[:, None] + inside).ravel()
    x, y = fine[None, :], fine[:, None]
    passed = np.hypot(x, y) >= telescope.obscuration * diameter_m / 2
    for angle in np.deg2rad(telescope.spiders_deg):
        along, across = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
        passed &= (along < 0) | (np.abs(across) > telescope.spider_m / 2)
    return np.asarray(passed.reshape(n, _POINTS, n, _POINTS).mean(axis=(1, 3)))


def soiled_share(
    dirt: TwinContamination,
    diameter_m: float,
    coordinates_m: NDArray[np.float64],
    rng: np.random.Generator,
) -> NDArray[np.float64]:
    """Share of the light that each sample of a soiled pupil still passes ``(n, n)``.

    The contaminated arc passes ``transmission``. The unevenness is a sum of a few waves with random
    phases, none shorter than a fifth of the diameter; the radius of the pupil varies likewise around
    its circumference, always inwards.

    Parameters
    ----------
    dirt
        What lies on the pupil.
    diameter_m, coordinates_m
        As for :func:`passed_share`.
    rng
        Of the unevenness.
    """
    u = coordinates_m / (diameter_m / 2)
    x, y = np.meshgrid(u, u)
    radius, angle = np.hypot(x, y), np.arctan2(y, x)
    across = _smooth(rng, (x, y))
    around = _smooth(rng, (angle / np.pi,))
    share = np.clip(1 + dirt.unevenness * across, 0, None)
    from_middle = np.abs((angle - np.deg2rad(dirt.angle_deg) + np.pi) % (2 * np.pi) - np.pi)
    arc = (from_middle <= np.pi * dirt.edge_share) & (radius > 1 - dirt.depth)
    if dirt.edge_share:
        share[arc] *= dirt.transmission
    if dirt.edge_unevenness:
        share[radius > 1 - dirt.edge_unevenness * np.abs(around)] = 0.0
    return np.asarray(share)


def _smooth(rng: np.random.Generator, axes: tuple[NDArray[np.float64], ...]) -> NDArray[np.float64]:
    """A random smooth function of unit mean square; each axis is periodic over -1..1."""
    total = np.zeros_like(axes[0])
    for _ in range(4 * _WAVES):
        waves = rng.integers(-_WAVES, _WAVES + 1, len(axes))
        if not waves.any():
            waves[0] = 1
        phase = rng.uniform(0, 2 * np.pi)
        total += np.cos(sum(np.pi * k * axis for k, axis in zip(waves, axes, strict=True)) + phase)
    return np.asarray(total / np.sqrt(2 * _WAVES))
