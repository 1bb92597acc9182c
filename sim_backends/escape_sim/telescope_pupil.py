"""What lies on the pupil."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from escape_hw.config.twin_sky import TwinContamination

#: Highest order of the smooth unevenness: waves across the pupil, or around its edge.
_WAVES = 5


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
        Diameter of the pupil, and coordinates of the samples along either axis ``(n,)``, in metres.
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
