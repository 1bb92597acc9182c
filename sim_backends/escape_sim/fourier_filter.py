"""Filters of square fields with dark borders, by fast Fourier transforms."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pyfftw
from numba import njit
from numpy.typing import NDArray

#: Columns beyond a row's end: rows of a power of two would all fall on the same lines of the cache.
_PAD = 8
#: Complex numbers in a line of the cache: a transposition moves so many columns at a time.
_LINE = 8


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


# One row at a time in a name of its own: only then does the compiler turn the loop into vectors.
@njit(cache=True, fastmath=True, nogil=True)
def _multiply(field, factors):  # type: ignore[no-untyped-def]  # pragma: no cover
    """``field[:, :n] *= factors``."""
    for i in range(factors.shape[0]):
        row, factor = field[i], factors[i]
        for j in range(factor.size):
            row[j] *= factor[j]


class FourierFilter:
    """A product in Fourier space, for fields that fill a corner of a periodic square.

    All transforms run along rows in memory, from one buffer to another, with transpositions
    between: FFTW then needs no trial runs to be at its best, and the same result comes out of every
    process to the last bit. Rows without light are not transformed, nor are rows that nobody wants.

    Not for two threads at a time: each needs a filter of its own.

    Parameters
    ----------
    transmission
        Factor ``(size, size)`` for each frequency, rows along y, in the order of a transform.
    n
        Side of the field.
    rows
        Number of output rows wanted, from row 0 on.

    Attributes
    ----------
    field
        Where to put the field: ``[:n, :n]`` of a larger array; the rest must stay zero.
    result
        Where the result will be: ``[:rows, :size]`` of a larger array. Not scaled: the inverse
        transform of numpy is smaller by ``size ** 2``.
    """

    def __init__(self, transmission: NDArray[np.complexfloating], n: int, rows: int) -> None:
        size = transmission.shape[0]
        self._n, self._size, self._rows = n, size, rows
        self._factors = np.ascontiguousarray(transmission.T, dtype=np.complex64)
        self.field, self._wide, a, b = (
            pyfftw.zeros_aligned((lines, size + _PAD), np.complex64) for lines in (n, *[size] * 3)
        )
        self.result, self._other = a, b
        # Along x over the lit rows, along y over all frequencies, back along y, back along x.
        self._steps = (
            _plan(self.field[:, :size], b[:n, :size], "FFTW_FORWARD"),
            _plan(self._wide[:, :size], b[:, :size], "FFTW_FORWARD"),
            _plan(b[:, :size], a[:, :size], "FFTW_BACKWARD"),
            _plan(b[:rows, :size], a[:rows, :size], "FFTW_BACKWARD"),
        )
        # Transposing moves whole complex numbers, as if they were doubles.
        self._moves = tuple(x.view(np.float64) for x in (a, b, self._wide))

    def run(self) -> None:
        """Filter ``field`` into ``result``."""
        a, b, wide = self._moves
        along_x, along_y, back_y, back_x = self._steps
        along_x()
        _transpose(b, self._n, self._size, wide)
        along_y()
        _multiply(self._other, self._factors)
        back_y()
        _transpose(a, self._size, self._rows, b)
        back_x()


def good_length(shortest: int, samples: int = 1) -> int:
    """The next number of pixels whose samples FFTW transforms at its best without trial runs."""
    length = shortest
    while not is_good(length * samples):
        length += 1
    return length


def is_good(samples: int) -> bool:
    """Whether the length is a power of two, at least 4, times 1, 3, 5, 9 or 25."""
    return samples % 4 == 0 and samples // (samples & -samples) in (1, 3, 5, 9, 25)


def _plan(source: NDArray[np.complex64], out: NDArray[np.complex64], direction: str) -> Callable[[], None]:
    """One transform per row, unscaled.

    Planned by rule and not by trial: trials choose differently from run to run, and a seed would no
    longer fix the frames.
    """
    plan = pyfftw.FFTW(source, out, axes=(1,), direction=direction, flags=("FFTW_ESTIMATE",), threads=1)
    execute: Callable[[], None] = plan.execute
    return execute
