"""Light through a pyramid whose images stand on a rectangle, by matrix products."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from escape_sim.prism import frequencies


@njit(cache=True, fastmath=True, nogil=True)
def _fold(field, tilt_y, tilt_x, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Parts of the tilted field that are even and odd along y and x: ``out (2, 2h, h)``.

    The first axis is the parity along x; the rows are the even part along y, then the odd one. Both
    tilts are those of the second half of the samples; those of the first half are their conjugates.
    """
    h = tilt_x.size
    for i in range(h):
        upper, lower, t = field[h - 1 - i], field[h + i], tilt_y[i]
        ee, eo, oe, oo = out[0, i], out[0, h + i], out[1, i], out[1, h + i]
        for j in range(h):
            u = tilt_x[j]
            turn, back = t * u, t * u.conjugate()
            a, b = lower[h + j] * turn, upper[h - 1 - j] * turn.conjugate()
            c, d = lower[h - 1 - j] * back, upper[h + j] * back.conjugate()
            ee[j] = (a + c) + (b + d)
            eo[j] = (a + c) - (b + d)
            oe[j] = (a - c) - (b - d)
            oo[j] = (a - c) + (b - d)


@njit(cache=True, fastmath=True, nogil=True)
def _unfold(parts, power):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add the power of even plus odd parts ``(2, H, 2H)`` to all four quarters of ``power (2H, 2H)``.

    The first axis is the parity along y; the columns are the even part along x, then the odd one.
    """
    half = parts.shape[1]
    for i in range(half):
        even, odd = parts[0, i], parts[1, i]
        up, down = power[half - 1 - i], power[half + i]
        for j in range(half):
            s, d = even[j] + odd[j], even[j] - odd[j]
            t, e = even[half + j] + odd[half + j], even[half + j] - odd[half + j]
            p, q, r, m = s + t, s - t, d + e, d - e
            down[half + j] += p.real * p.real + p.imag * p.imag
            down[half - 1 - j] += q.real * q.real + q.imag * q.imag
            up[half + j] += r.real * r.real + r.imag * r.imag
            up[half - 1 - j] += m.real * m.real + m.imag * m.imag


def spread(n: int, n_grid: int, shift: float) -> NDArray[np.complex128]:
    """Matrix ``(n_grid, n)`` from pupil samples to the images ``+-shift`` samples away, along one axis.

    It is zero padding, Fourier transform, the factor ``exp(-2 i pi shift |k|)`` and inverse
    transform in one: ``sum_k exp(2 i pi k (u - p) - 2 i pi shift |k|) / n_grid``, with ``u`` and
    ``p`` counted from the middle.
    """
    k = frequencies(n_grid)
    u = np.arange(n_grid) - (n_grid - 1) / 2
    p = np.arange(n) - (n - 1) / 2
    there = np.exp(2j * np.pi * np.outer(u, k) - 2j * np.pi * shift * np.abs(k)) / n_grid
    return np.asarray(there @ np.exp(-2j * np.pi * np.outer(k, p)))


def _halves(matrix: NDArray[np.complex128]) -> NDArray[np.complex64]:
    """What an even and an odd input see of :func:`spread`: ``(2, n_grid / 2, n / 2)``."""
    # The matrix is the same read from both ends, so half of it says all.
    rows, columns = matrix.shape[0] // 2, matrix.shape[1] // 2
    near, far = matrix[rows:, columns:], matrix[rows:, columns - 1 :: -1]
    return np.stack([near + far, near - far]).astype(np.complex64)


class SeparableKernel:
    """Power of a field behind the prism, summed over modulation points, by matrix products.

    With the images on a rectangle the transmission is ``m(x) m(y)``, and everything from the pupil
    to the camera is ``A field B^T``. Both matrices are the same from either end, so even and odd
    parts of the field stay apart and each product needs half the work.

    Not for two threads at a time: each needs a kernel of its own.

    Parameters
    ----------
    shift_x, shift_y
        Half the distance of the images along x and y in samples.
    n
        Pupil samples across the field, even.
    n_grid
        Side of the grid, even; the images stand around its middle.
    """

    def __init__(self, shift_x: float, shift_y: float, n: int, n_grid: int) -> None:
        h, half = n // 2, n_grid // 2
        self.shape = (n_grid, n_grid)
        self._n = n
        self._along_x = np.ascontiguousarray(_halves(spread(n, n_grid, shift_x)).transpose(0, 2, 1))
        # The four sums of a fold each count a sample four times over.
        self._along_y = _halves(spread(n, n_grid, shift_y)) / np.complex64(4)
        self._folded = np.empty((2, n, h), np.complex64)
        self._half = np.empty((2, n, half), np.complex64)
        self._rows = np.empty((2, h, n_grid), np.complex64)
        self._parts = np.empty((2, half, n_grid), np.complex64)

    def tilts(self, turns: NDArray[np.float64]) -> NDArray[np.complex64]:
        """Factors ``(k, n / 2)`` for tilts of so many turns of phase per sample ``(k,)``."""
        samples = np.arange(self._n // 2) + 0.5
        return np.asarray(np.exp(2j * np.pi * np.outer(turns, samples)), np.complex64)

    def add(
        self,
        field: NDArray[np.complex64],
        tilts_x: NDArray[np.complex64],
        tilts_y: NDArray[np.complex64],
        power: NDArray[np.float32],
    ) -> None:
        """Add the power of ``field (n, n)`` under each tilt to ``power`` (of ``shape``)."""
        half = self.shape[0] // 2
        h = self._n // 2
        for tilt_x, tilt_y in zip(tilts_x, tilts_y, strict=True):
            _fold(field, tilt_y, tilt_x, self._folded)
            np.matmul(self._folded, self._along_x, out=self._half)
            for parity in range(2):
                self._rows[:, :, parity * half : (parity + 1) * half] = self._half[parity].reshape(2, h, half)
            np.matmul(self._along_y, self._rows, out=self._parts)
            _unfold(self._parts, power)
