"""Poisson numbers for faint light, exact and fast, drawn inside compiled loops."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy import special

#: Above this mean the distribution is close enough to a Gaussian of the same mean and variance.
MOST = 20.0
#: Tables per unit of the mean, numbers per table, and entries into each of them.
_PER_UNIT, _NUMBERS, _ENTRIES = 16, 64, 256


def poisson_tables() -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Tables from which :func:`draw_poisson` draws.

    Returns
    -------
    cumulative : ndarray of float32, ``(n_means, 64)``
        Probability of at most ``k``, for means of 0, 1/16, 2/16, ...
    entry : ndarray of uint8, ``(n_means, 256)``
        Where to begin looking for a uniform number, by its first 8 bits.
    """
    means = np.arange(int(MOST * _PER_UNIT) + 1) / _PER_UNIT
    exact = special.pdtr(np.arange(_NUMBERS), means[:, None])
    exact[:, -1] = 2.0  # so that no uniform number finds an end
    starts = np.arange(_ENTRIES) / _ENTRIES
    entry = np.array([np.searchsorted(row, starts, side="right") for row in exact], np.uint8)
    return exact.astype(np.float32), entry


@njit(cache=True, nogil=True, inline="always")
def uniform_pair(key, index):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Two uniform numbers in [0, 1) for an index under a 64-bit key: a hash, so nothing is carried along.

    The finaliser is that of SplitMix64 (Steele, Lea and Flood 2014).
    """
    z = np.uint64(key) + np.uint64(index + 1) * np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z = z ^ (z >> np.uint64(31))
    scale = np.float32(1.0 / (1 << 24))
    return np.float32(z >> np.uint64(40)) * scale, np.float32(
        (z >> np.uint64(8)) & np.uint64(0xFFFFFF)
    ) * scale


@njit(cache=True, nogil=True, inline="always")
def draw_poisson(mean, first, second, cumulative, entry):  # type: ignore[no-untyped-def]  # pragma: no cover
    """A Poisson number of a mean up to :data:`MOST`, from two uniform numbers.

    The sum of two Poisson numbers is one: of a mean on the tables' grid, found by inversion from an
    entry that is nearly always right, and of the small rest, found by going up from zero.
    """
    row = int(mean * np.float32(16))
    u = first
    k = int(entry[row, int(u * np.float32(256))])
    while cumulative[row, k] <= u:
        k += 1
    rest = mean - np.float32(row) * np.float32(1 / 16)
    # exp(-rest) for rest < 1/16; the next term is below the resolution of single precision.
    term = np.float32(1) - rest * (
        np.float32(1) - rest * (np.float32(0.5) - rest * (np.float32(1 / 6) - rest * np.float32(1 / 24)))
    )
    total, more = term, np.float32(0)
    while total <= second and more < np.float32(8):
        more += np.float32(1)
        term *= rest / more
        total += term
    return np.float32(k) + more
