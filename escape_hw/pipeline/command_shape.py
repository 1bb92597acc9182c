"""From modal commands to shapes of the mirror, frame by frame."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from escape_hw.pipeline.packed_matrix import LARGE

#: Makes of a modal command ``(n_modes,)`` a shape ``(n_act,)``, the same array at every call.
Shaper = Callable[[NDArray[np.float64]], NDArray[np.float64]]


def shaper(m2c: NDArray[np.float64]) -> Shaper:
    """The fastest way to multiply with a mode-to-command matrix ``(n_act, n_modes)``.

    Zonal modes move one actuator each: no product is needed. A large matrix of other modes is held in single
    precision, which is a hundred thousand times finer than a mirror's steps.

    Parameters
    ----------
    m2c
        The matrix.
    """
    shape = np.zeros(m2c.shape[0])
    alone = zonal_places(m2c)
    if alone is not None:
        places, sizes = alone

        def by_actuator(modes: NDArray[np.float64]) -> NDArray[np.float64]:
            shape[places] = modes * sizes
            return shape

        return by_actuator
    if m2c.size * np.float32().nbytes > LARGE:
        single, vector = np.ascontiguousarray(m2c, np.float32), np.zeros(m2c.shape[1], np.float32)
        product = np.zeros(m2c.shape[0], np.float32)

        def in_single_precision(modes: NDArray[np.float64]) -> NDArray[np.float64]:
            vector[:] = modes
            shape[:] = np.dot(single, vector, out=product)
            return shape

        return in_single_precision
    matrix = np.ascontiguousarray(m2c)
    return lambda modes: np.dot(matrix, modes, out=shape)


def zonal_places(m2c: NDArray[np.float64]) -> tuple[NDArray[np.intp], NDArray[np.float64]] | None:
    """Which actuator each mode moves, and by how much, if each moves one of its own; ``None`` otherwise."""
    moved = m2c != 0
    if not (moved.sum(axis=0) == 1).all() or moved.sum(axis=1).max() > 1:
        return None
    places = moved.argmax(axis=0)
    return places, m2c[places, np.arange(m2c.shape[1])]
