"""Shadow of the secondary mirror and its vanes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from escape_hw.config.system import TelescopeSection

#: Points along each side of a sample at which the transmission is evaluated.
_POINTS = 8
#: Points along each side of a sample of a shadow map, whose samples are much smaller than pixels.
_COARSE_POINTS = 2
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
