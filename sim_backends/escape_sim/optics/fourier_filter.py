"""Filtering of square, zero-padded fields by fast Fourier transforms (FFTW)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pyfftw
from numba import njit
from numpy.typing import NDArray

#: Columns added to each row: rows of a power of two would share the same cache lines.
_ROW_PADDING = 8
#: Complex numbers per cache line; columns transposed at a time.
_CACHE_LINE = 8


@njit(cache=True, nogil=True)
def _transpose(source, rows, columns, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """``out[:columns, :rows] = source[:rows, :columns].T`` for any 8-byte numbers."""
    n_aligned = rows - rows % _CACHE_LINE
    for i0 in range(0, n_aligned, _CACHE_LINE):
        for j in range(columns):
            for i in range(_CACHE_LINE):
                out[j, i0 + i] = source[i0 + i, j]
    for j in range(columns):
        for i in range(n_aligned, rows):
            out[j, i] = source[i, j]


# The loops over rows use local names, without which the compiler does not vectorise them.
@njit(cache=True, fastmath=True, nogil=True)
def _multiply(field, factors):  # type: ignore[no-untyped-def]  # pragma: no cover
    """``field[:, :n] *= factors``."""
    for i in range(factors.shape[0]):
        row, factor = field[i], factors[i]
        for j in range(factor.size):
            row[j] *= factor[j]


class FourierFilter:
    """Multiplication in Fourier space of fields that fill a corner of a periodic square.

    All transforms run along contiguous rows, from one buffer to another, with transpositions in between.
    FFTW is then fast without trial runs, and results are identical in every process. Dark input rows
    and unused output rows are not transformed. Not thread-safe: use one filter per thread.

    Parameters
    ----------
    transmission
        Factor ``(size, size)`` for each frequency, rows along y, in the order of a transform.
    n, rows
        Side of the field, and number of output rows wanted, from row 0 on.

    Attributes
    ----------
    field, result
        Input ``[:n, :n]`` of a larger array, whose rest must stay zero; output ``[:rows, :size]`` of a larger
        array, ``size ** 2`` times numpy's inverse transform.
    """

    def __init__(self, transmission: NDArray[np.complexfloating], n: int, rows: int) -> None:
        size = transmission.shape[0]
        self._n, self._size, self._rows = n, size, rows
        self._factors = np.ascontiguousarray(transmission.T, dtype=np.complex64)
        self.field, self._column_buffer, first_view, second_view = (
            pyfftw.zeros_aligned((lines, size + _ROW_PADDING), np.complex64) for lines in (n, *[size] * 3)
        )
        self.result, self._work = first_view, second_view
        # Along x over the lit rows, along y over all frequencies, inverse along y, inverse along x.
        self._steps = (
            _plan_transform(self.field[:, :size], second_view[:n, :size], "FFTW_FORWARD"),
            _plan_transform(self._column_buffer[:, :size], second_view[:, :size], "FFTW_FORWARD"),
            _plan_transform(second_view[:, :size], first_view[:, :size], "FFTW_BACKWARD"),
            _plan_transform(second_view[:rows, :size], first_view[:rows, :size], "FFTW_BACKWARD"),
        )
        # Complex numbers of 8 bytes are transposed as doubles.
        self._transpose_views = tuple(
            x.view(np.float64) for x in (first_view, second_view, self._column_buffer)
        )

    def run(self) -> None:
        """Filter ``field`` into ``result``."""
        first_view, second_view, column_view = self._transpose_views
        along_x, along_y, back_y, back_x = self._steps
        along_x()
        _transpose(second_view, self._n, self._size, column_view)
        along_y()
        _multiply(self._work, self._factors)
        back_y()
        _transpose(first_view, self._size, self._rows, second_view)
        back_x()


def next_fast_length(shortest: int, samples: int = 1) -> int:
    """Smallest number of pixels, from ``shortest`` on, whose samples FFTW transforms fast without trials."""
    length = shortest
    while not is_fast_length(length * samples):
        length += 1
    return length


def is_fast_length(samples: int) -> bool:
    """Whether the length is a power of two, at least 4, times 1, 3, 5, 9 or 25."""
    return samples % 4 == 0 and samples // (samples & -samples) in (1, 3, 5, 9, 25)


def _plan_transform(
    source: NDArray[np.complex64], out: NDArray[np.complex64], direction: str
) -> Callable[[], None]:
    """Plan one unscaled transform per row.

    The plan follows rules (``FFTW_ESTIMATE``): trial runs would choose differently each time, and the
    seed would no longer fix the frames.
    """
    plan = pyfftw.FFTW(source, out, axes=(1,), direction=direction, flags=("FFTW_ESTIMATE",), threads=1)
    execute: Callable[[], None] = plan.execute
    return execute
