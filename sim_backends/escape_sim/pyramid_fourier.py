"""Light through any pyramid prism by fast Fourier transforms."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from escape_sim.fourier_filter import FourierFilter
from escape_sim.prism import Prism, frequencies


# One row at a time in a name of its own: only then does the compiler turn the loops into vectors.
@njit(cache=True, fastmath=True, nogil=True)
def _tilt(field, tilt_y, tilt_x, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """``out[:, :n] = tilt_y[:, None] field tilt_x``."""
    for i in range(field.shape[0]):
        source, row, turn = field[i], out[i], tilt_y[i]
        for j in range(tilt_x.size):
            row[j] = source[j] * (tilt_x[j] * turn)


@njit(cache=True, fastmath=True, nogil=True)
def _add_power(field, power):  # type: ignore[no-untyped-def]  # pragma: no cover
    """``power += |field[:, :n]|**2``."""
    for i in range(power.shape[0]):
        row, total = field[i], power[i]
        for j in range(total.size):
            total[j] += row[j].real * row[j].real + row[j].imag * row[j].imag


class FourierKernel:
    """Power of a field behind the prism, summed over modulation points, on a periodic grid.

    Not for two threads at a time: each needs a kernel of its own.

    Parameters
    ----------
    prism
        The faces.
    n
        Pupil samples across the field.
    n_grid
        Side of the grid, even. Light that leaves it on one side comes in on the other.
    rows
        Number of output rows wanted, from row 0 on.
    """

    def __init__(self, prism: Prism, n: int, n_grid: int, rows: int) -> None:
        self.shape = (rows, n_grid)
        self._n = n
        # Half-integer frequencies, and the scale of the inverse transform, ride on the tilts.
        self._carrier = np.exp(-2j * np.pi * frequencies(n_grid)[0] * np.arange(n)) / n_grid
        self._filter = FourierFilter(prism.mask(n_grid), n, rows)

    def tilts(self, turns: NDArray[np.float64]) -> NDArray[np.complex64]:
        """Factors ``(k, n)`` for tilts of so many turns of phase per sample ``(k,)``."""
        samples = np.arange(self._n) - (self._n - 1) / 2
        return np.asarray(self._carrier * np.exp(2j * np.pi * np.outer(turns, samples)), np.complex64)

    def add(
        self,
        field: NDArray[np.complex64],
        tilts_x: NDArray[np.complex64],
        tilts_y: NDArray[np.complex64],
        power: NDArray[np.float32],
    ) -> None:
        """Add the power of ``field (n, n)`` under each tilt to ``power`` (of ``shape``)."""
        for tilt_x, tilt_y in zip(tilts_x, tilts_y, strict=True):
            _tilt(field, tilt_y, tilt_x, self._filter.field)
            self._filter.run()
            _add_power(self._filter.result, power)
