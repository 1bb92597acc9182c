"""Light through any pyramid prism by fast Fourier transforms."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pyfftw
from numba import njit
from numpy.typing import NDArray

from escape_sim.prism import Prism, frequencies

#: Columns beyond a row's end: rows of a power of two would all fall on the same lines of the cache.
_PAD = 8
#: Complex numbers in a line of the cache: a transposition moves so many columns at a time.
_LINE = 8


# One row at a time in a name of its own: only then does the compiler turn the loops into vectors.
@njit(cache=True, fastmath=True, nogil=True)
def _tilt(field, tilt_y, tilt_x, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """``out[:, :n] = tilt_y[:, None] field tilt_x``."""
    for i in range(field.shape[0]):
        source, row, turn = field[i], out[i], tilt_y[i]
        for j in range(tilt_x.size):
            row[j] = source[j] * (tilt_x[j] * turn)


@njit(cache=True, nogil=True)
def _transpose(source, rows, columns, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """``out[:columns, :rows] = source[:rows, :columns].T`` for any 8-byte numbers."""
    whole = rows - rows % _LINE
    for i0 in range(0, whole, _LINE):
        for j in range(columns):
            for i in range(_LINE):
                out[j, i0 + i] = source[i0 + i, j]
    for j in range(columns):
        for i in range(whole, rows):
            out[j, i] = source[i, j]


@njit(cache=True, fastmath=True, nogil=True)
def _filter(field, mask):  # type: ignore[no-untyped-def]  # pragma: no cover
    """``field[:, :n] *= mask``."""
    for i in range(mask.shape[0]):
        row, factor = field[i], mask[i]
        for j in range(factor.size):
            row[j] *= factor[j]


@njit(cache=True, fastmath=True, nogil=True)
def _add_power(field, power):  # type: ignore[no-untyped-def]  # pragma: no cover
    """``power += |field[:, :n]|**2``."""
    for i in range(power.shape[0]):
        row, total = field[i], power[i]
        for j in range(total.size):
            total[j] += row[j].real * row[j].real + row[j].imag * row[j].imag


class FourierKernel:
    """Power of a field behind the prism, summed over modulation points, on a periodic grid.

    All transforms run along rows in memory, from one buffer to another, with transpositions
    between: FFTW then needs no trial runs to be at its best, and the same frame comes out of every
    process to the last bit. Rows of the padded pupil without light are not transformed.

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
        self._n, self._n_grid = n, n_grid
        self._mask = np.ascontiguousarray(prism.mask(n_grid).T, dtype=np.complex64)
        # Half-integer frequencies, and the scale of the inverse transform, ride on the tilts.
        self._carrier = np.exp(-2j * np.pi * frequencies(n_grid)[0] * np.arange(n)) / n_grid
        self._lit, self._wide, self._a, self._b = (
            pyfftw.zeros_aligned((lines, n_grid + _PAD), np.complex64) for lines in (n, *[n_grid] * 3)
        )
        a, b = self._a[:, :n_grid], self._b[:, :n_grid]
        self._steps = (
            _plan(self._lit[:, :n_grid], b[:n], "FFTW_FORWARD"),
            _plan(self._wide[:, :n_grid], b, "FFTW_FORWARD"),
            _plan(b, a, "FFTW_BACKWARD"),
            _plan(b[:rows], a[:rows], "FFTW_BACKWARD"),
        )

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
        n, size, rows = self._n, self._n_grid, self.shape[0]
        # Transposing moves whole complex numbers, as if they were doubles.
        a, b, wide = (x.view(np.float64) for x in (self._a, self._b, self._wide))
        along_x, along_y, back_y, back_x = self._steps
        for tilt_x, tilt_y in zip(tilts_x, tilts_y, strict=True):
            _tilt(field, tilt_y, tilt_x, self._lit)
            along_x()
            _transpose(b, n, size, wide)
            along_y()
            _filter(self._b, self._mask)
            back_y()
            _transpose(a, size, rows, b)
            back_x()
            _add_power(self._a, power)


def _plan(source: NDArray[np.complex64], out: NDArray[np.complex64], direction: str) -> Callable[[], None]:
    """One transform per row, unscaled.

    Planned by rule and not by trial: trials choose differently from run to run, and a seed would no
    longer fix the frames.
    """
    plan = pyfftw.FFTW(source, out, axes=(1,), direction=direction, flags=("FFTW_ESTIMATE",), threads=1)
    execute: Callable[[], None] = plan.execute
    return execute
