"""The linear map from a smooth mirror surface to Shack-Hartmann slopes, lenslet by lenslet."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import DTypeLike, NDArray

from escape_sim.mode_surfaces import GaussianFactors

#: Nodes across a lenslet that carry a surface as smooth as an influence function: with 6, what is
#: lost of a Gaussian two lenslets wide is 1e-8 of its slope.
NODES = 6
#: Lenslets whose light a window sees, per axis.
_REACH = 3


class SlopeOperator:
    """Slopes of surfaces given on a few nodes per lenslet.

    A window sees its own lenslet and the eight around it, so each slope is a weighted sum over
    ``3 x 3`` lenslets of ``NODES x NODES`` nodes.

    Parameters
    ----------
    weights
        ``(2, n_valid, p, p)`` for each step (rows down, columns right) to a lenslet around: slopes
        per unit of surface on each pupil sample, x then y.
    valid
        Lenslets with a window ``(n_sub, n_sub)``.
    sub_aperture_m
        Size of a sub-aperture in metres.
    """

    def __init__(
        self,
        weights: dict[tuple[int, int], NDArray[np.float64]],
        valid: NDArray[np.bool_],
        sub_aperture_m: float,
    ) -> None:
        rows, columns = np.nonzero(valid)
        n_sub = len(valid)
        p = next(iter(weights.values())).shape[-1]
        nodes, carry = _nodes(p)
        k = nodes.size
        table = np.zeros((rows.size, 2, _REACH, k, _REACH, k))
        for (down, right), block in weights.items():
            table[:, :, down + 1, :, right + 1, :] = (carry.T @ block @ carry).transpose(1, 0, 2, 3)
        self._table = table.reshape(rows.size, 2, _REACH * k, _REACH * k)
        # Lenslets beyond the edge exist on the grid of nodes, with weights of zero.
        lattice = np.arange(-1, n_sub + 1) - (n_sub - 1) / 2
        self.nodes_m = ((lattice[:, None] + nodes) * sub_aperture_m).ravel()
        self._first_y, self._first_x = (rows * k).astype(np.int64), (columns * k).astype(np.int64)
        self._cast: dict[str, NDArray[np.floating]] = {}

    @property
    def n_slopes(self) -> int:
        """Number of slopes, all x and then all y."""
        return 2 * len(self._table)

    def slopes(self, surfaces: NDArray[np.floating]) -> NDArray[np.floating]:
        """Slopes ``(n_slopes, n)`` of surfaces ``(n_nodes, n_nodes, n)`` on the nodes.

        Every node is weighted once per window, so this is the way for a few surfaces.
        """
        out = np.zeros((2, len(self._table), surfaces.shape[2]), surfaces.dtype)
        _apply(self._weights(surfaces.dtype), self._first_y, self._first_x, surfaces, out)
        return out.reshape(self.n_slopes, -1)

    def zonal(self, factors: GaussianFactors, *, derivatives: bool = False) -> NDArray[np.floating]:
        """Slopes of all influence functions, made from their factors without forming surfaces.

        Returns
        -------
        ndarray, ``(n, n_slopes, n_act)``
            ``n`` is 1, or 5 with derivatives: the slopes, then their derivatives by the place along x
            and y and by the logarithm of the width along x and y.
        """
        x, y = factors.along_x, factors.along_y
        kinds = 3 if derivatives else 1
        side = np.ascontiguousarray(x[:kinds].transpose(1, 0, 2)).reshape(x.shape[1], -1)
        out = np.zeros((5 if derivatives else 1, 2, len(self._table), x.shape[2]), x.dtype)
        _zonal(self._weights(x.dtype), self._first_y, self._first_x, side, y, out)
        return out.reshape(len(out), self.n_slopes, -1)

    def _weights(self, dtype: DTypeLike) -> NDArray[np.floating]:
        kind = np.dtype(dtype).str
        if kind not in self._cast:
            self._cast[kind] = np.ascontiguousarray(self._table, dtype=np.dtype(kind))
        return self._cast[kind]


def _nodes(p: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Nodes within a lenslet ``(k,)`` of unit size, and the map ``(p, k)`` from them to the samples."""
    samples = (np.arange(p) - (p - 1) / 2) / p
    if p <= NODES:
        return samples, np.eye(p)
    nodes = np.polynomial.legendre.leggauss(NODES)[0] / 2
    carry = np.ones((p, NODES))
    for j in range(NODES):
        for i in range(NODES):
            if i != j:
                carry[:, j] *= (samples - nodes[i]) / (nodes[j] - nodes[i])
    return nodes, carry


@njit(cache=True, fastmath=True, nogil=True)
def _apply(table, first_y, first_x, surfaces, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Weighted sums of surfaces ``(n_y, n_x, n)`` into ``out (2, n_valid, n)``."""
    size, n = table.shape[2], surfaces.shape[2]
    for s in range(table.shape[0]):
        for q in range(size):
            row = surfaces[first_y[s] + q]
            for r in range(size):
                along_x, along_y = table[s, 0, q, r], table[s, 1, q, r]
                at = row[first_x[s] + r]
                for m in range(n):
                    out[0, s, m] += along_x * at[m]
                    out[1, s, m] += along_y * at[m]


@njit(cache=True, fastmath=True, nogil=True)
def _zonal(table, first_y, first_x, side, y, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Sums over both factors; ``side (n_x, kinds * n_act)``, ``y (3, n_y, n_act)``."""
    size, n_act = table.shape[2], y.shape[2]
    # Products this small stay on one thread in any linear-algebra library.
    lines = np.empty((2 * size, side.shape[1]), side.dtype)
    for s in range(table.shape[0]):
        np.dot(table[s].reshape(2 * size, size), side[first_x[s] : first_x[s] + size], lines)
        for axis in range(2):
            for q in range(size):
                line, row = lines[axis * size + q], first_y[s] + q
                for a in range(n_act):
                    out[0, axis, s, a] += y[0, row, a] * line[a]
                if out.shape[0] > 1:
                    for a in range(n_act):
                        out[1, axis, s, a] += y[0, row, a] * line[n_act + a]
                        out[2, axis, s, a] += y[1, row, a] * line[a]
                        out[3, axis, s, a] += y[0, row, a] * line[2 * n_act + a]
                        out[4, axis, s, a] += y[2, row, a] * line[a]
