"""Second-order statistics of turbulence."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import gamma, kv


def structure_function(
    distance_m: NDArray[np.float64], r0_m: float, outer_scale_m: float = np.inf
) -> NDArray[np.float64]:
    """Mean square difference in square radians of the phase between points so far apart.

    Kolmogorov's ``6.88 (r / r0)^(5/3)`` without an outer scale, von Kármán's with one (Conan 2000,
    thesis, eq. 1.28; its limit at small distances is Kolmogorov's).

    Parameters
    ----------
    distance_m
        Distances in metres.
    r0_m
        Fried parameter in metres, at the wavelength of the phase.
    outer_scale_m
        Outer scale in metres.
    """
    r = np.abs(np.asarray(distance_m, dtype=float))
    constant = (24 / 5 * gamma(6 / 5)) ** (5 / 6)
    if np.isinf(outer_scale_m):
        return np.asarray(2 * constant * (r / r0_m) ** (5 / 3))
    x = np.maximum(2 * np.pi * r / outer_scale_m, 1e-9)
    scale = 2 ** (1 / 6) * gamma(11 / 6) / np.pi ** (8 / 3) * constant * (outer_scale_m / r0_m) ** (5 / 3)
    # The two terms cancel at small distances, down to rounding.
    return np.where(
        r > 0, scale * np.maximum(gamma(5 / 6) / 2 ** (1 / 6) - x ** (5 / 6) * kv(5 / 6, x), 0), 0.0
    )
