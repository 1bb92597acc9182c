"""What a measurement has so far, for those who watch, at a small share of its time."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.sensor import SensorGeometry

#: Seconds between two pictures at least ...
PERIOD_S = 1.0
#: ... and share of the time that making them may take.
MAX_TIME_FRACTION = 0.04

#: Matrix and its standard errors ``(n_slopes, n)``; ``None``: nothing to show yet.
MatrixEstimate = tuple[NDArray[np.floating], NDArray[np.floating]] | None


class MatrixPreview:
    """Makes pictures of an estimate now and then.

    Parameters
    ----------
    n_modes
        Modes of the whole matrix; those not measured yet are shown as NaN.
    grid
        Tells the geometry that the slopes belong to, once it is known.
    """

    def __init__(self, n_modes: int, grid: Callable[[], SensorGeometry | None]) -> None:
        self._n_modes, self._grid = n_modes, grid
        self._next = time.monotonic() + PERIOD_S

    def due(self) -> bool:
        """Whether the next picture may be made; cheap enough to be asked for every frame."""
        return time.monotonic() >= self._next

    def __call__(self, estimate: Callable[[], MatrixEstimate]) -> Mapping[str, NDArray[np.float32]]:
        """The arrays to show, made by ``estimate``; empty when there are none."""
        began = time.monotonic()
        result = estimate()
        arrays = {} if result is None else self._arrays(*result)
        now = time.monotonic()
        self._next = now + max(PERIOD_S, (now - began) / MAX_TIME_FRACTION)
        return arrays

    def _arrays(
        self, matrix: NDArray[np.floating], sigma: NDArray[np.floating]
    ) -> Mapping[str, NDArray[np.float32]]:
        grid = self._grid()
        mask = {} if grid is None else {"valid": grid.valid.astype(np.float32)}
        return {**mask, "matrix": self._pad_modes(matrix), "matrix_sigma": self._pad_modes(sigma)}

    def _pad_modes(self, columns: NDArray[np.floating]) -> NDArray[np.float32]:
        """All modes, also those not measured yet."""
        if columns.shape[1] == self._n_modes:
            return columns.astype(np.float32)
        padded = np.full((columns.shape[0], self._n_modes), np.nan, np.float32)
        padded[:, : columns.shape[1]] = columns
        return padded
