"""Large matrices in 16 bits, for products that take as long as their matrix takes to arrive."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

#: Bytes in single precision above which a matrix is packed: what a processor's own cache does not hold.
LARGE = 4 << 20
_TOP = 32767


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _product(mantissa, scale, vector, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Sums may be taken in any order, which vectorises them; what is not finite stays so."""
    rows, columns = mantissa.shape
    for i in range(rows):
        total = np.float32(0)
        for j in range(columns):
            total += np.float32(mantissa[i, j]) * vector[j]
        out[i] = total * scale[i]


@dataclass(frozen=True, slots=True, eq=False)
class PackedMatrix:
    """A matrix whose rows are whole numbers of 16 bits times a factor each.

    A product with a vector reads half the memory that single precision does, and takes half the time. Each
    element is off by at most 1/65534 of the largest in its row, so a product of a reconstructor by about
    1e-4 of itself: far below the noise of any slope.

    Parameters
    ----------
    mantissa
        ``(rows, columns)``, int16.
    scale
        ``(rows,)``, float32.
    """

    mantissa: NDArray[np.int16]
    scale: NDArray[np.float32]

    @classmethod
    def of(cls, matrix: NDArray[np.float32]) -> PackedMatrix:
        """Pack a finite matrix ``(rows, columns)``."""
        scale = np.abs(matrix).max(axis=1) / np.float32(_TOP)
        shares = matrix / np.where(scale > 0, scale, 1)[:, None]
        return cls(np.ascontiguousarray(np.rint(shares), np.int16), scale.astype(np.float32))

    def product(self, vector: NDArray[np.float32], out: NDArray[np.float32]) -> None:
        """Fill ``out (rows,)`` with the product with ``vector (columns,)``."""
        _product(self.mantissa, self.scale, vector, out)
