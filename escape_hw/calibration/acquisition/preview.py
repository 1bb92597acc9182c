"""Intermediate interaction matrices for display, at a bounded share of the run time."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.sensor import SensorGeometry

#: Least seconds between two previews, and the share of the run time that they may take.
PERIOD_S = 1.0
MAX_TIME_FRACTION = 0.04

#: Matrix and its standard errors ``(n_slopes, n)``; ``None`` if there is no estimate yet.
MatrixEstimate = tuple[NDArray[np.floating], NDArray[np.floating]] | None


#: Largest delay of the slopes after a poke that :func:`correlate_pokes` tries, and least number of frames.
_MAX_LAG, _MIN_FRAMES = 4, 50


def correlate_pokes(slopes: NDArray[np.floating], pokes: NDArray[np.floating]) -> MatrixEstimate:
    """Matrix from the correlation of the slopes with the pokes some frames before, for display.

    The delay with the largest correlation is taken. Neither the turbulence nor the correlations between the
    pokes are removed.

    ``slopes``: ``(n_frames, n_slopes)``; ``pokes``: ``(n_frames, n_modes)``.
    """
    if len(slopes) < _MIN_FRAMES:
        return None
    centred = slopes - slopes.mean(axis=0)
    power = np.maximum(np.square(pokes).sum(axis=0), 1e-30)
    products = [centred[lag:].T @ pokes[: len(pokes) - lag] for lag in range(_MAX_LAG + 1)]
    strongest = max(products, key=lambda one: float(np.square(one / np.sqrt(power)).sum()))
    sigma = centred.std(axis=0)[:, None] / np.sqrt(power)
    return strongest / power, sigma


class MatrixPreview:
    """Limits how often an estimate is previewed, and arranges it for display.

    ``n_modes``: modes of the complete matrix; those not measured yet are NaN; ``grid``: returns the geometry
    of the slopes, or ``None`` while it is not known.
    """

    def __init__(self, n_modes: int, grid: Callable[[], SensorGeometry | None]) -> None:
        self._n_modes, self._grid = n_modes, grid
        self._next = time.monotonic() + PERIOD_S

    def is_due(self) -> bool:
        """Whether the next preview is allowed; fast enough for every frame."""
        return time.monotonic() >= self._next

    def __call__(self, estimate: Callable[[], MatrixEstimate]) -> Mapping[str, NDArray[np.float32]]:
        """Arrays ``matrix``, ``matrix_sigma`` and ``valid`` of an estimate; empty if it is ``None``."""
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
        if columns.shape[1] == self._n_modes:
            return columns.astype(np.float32)
        padded = np.full((columns.shape[0], self._n_modes), np.nan, np.float32)
        padded[:, : columns.shape[1]] = columns
        return padded
