"""Slopes of surfaces on lenslets, from weights of the optical path and surfaces at a few nodes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit
from numpy.typing import DTypeLike, NDArray

from escape_sim.mirror.mode_surfaces import Products

#: Nodes across a lenslet that interpolate a mirror surface: with 6, the error for a Gaussian two
#: lenslets wide is 1e-8 of its slope.
NODES = 6
#: Lenslets per axis whose light a window receives.
_LENSLETS_ACROSS = 3
#: Nodes that are weighted at once, written out in :func:`_apply_to_products`.
_AT_ONCE = 4
#: Products of peaks below this many machine epsilons of the largest one are not computed.
_NEGLIGIBLE_SHARE = 0.01


class SlopeOperator:
    """Slopes of surfaces given at a few nodes per lenslet.

    A window receives light of its own lenslet and the eight around it, so each slope is a weighted sum
    over ``3 x 3`` lenslets of ``NODES x NODES`` nodes.

    Parameters
    ----------
    weights
        Derivatives of the slopes by the optical path ``(2, n_valid, p, p)`` in pixels per metre, for each
        step to a lenslet whose light a window receives (:func:`~.shack_hartmann.slope_weights`).
    valid
        Lenslets with a window ``(n_sub, n_sub)``.
    sub_aperture_m
        Size of a lenslet on the pupil in metres.
    """

    def __init__(
        self,
        weights: dict[tuple[int, int], NDArray[np.float64]],
        valid: NDArray[np.bool_],
        sub_aperture_m: float,
    ) -> None:
        rows, columns = np.nonzero(valid)
        n_sub, n_valid = len(valid), len(rows)
        p = next(iter(weights.values())).shape[-1]
        nodes, interpolation = _lenslet_nodes(p)
        k, across = nodes.size, n_sub + 2
        table = np.zeros((n_valid, 2, _LENSLETS_ACROSS, k, _LENSLETS_ACROSS, k))
        # The same by lenslet: weights on the slopes of the windows that receive its light, and their numbers.
        by_lenslet = np.zeros((across, across, len(weights), 2, k * k + -k * k % _AT_ONCE))
        slopes = np.full((across, across, len(weights), 2), -1)
        for number, ((down, right), block) in enumerate(weights.items()):
            at_nodes = (interpolation.T @ block @ interpolation).transpose(1, 0, 2, 3)
            table[:, :, down + 1, :, right + 1, :] = at_nodes
            at_nodes = at_nodes.reshape(n_valid, 2, -1)
            by_lenslet[rows + 1 + down, columns + 1 + right, number, :, : k * k] = at_nodes
            slopes[rows + 1 + down, columns + 1 + right, number] = np.arange(2 * n_valid).reshape(2, -1).T
        self._table = table.reshape(n_valid, 2, _LENSLETS_ACROSS * k, _LENSLETS_ACROSS * k)
        self._lenslets = np.argwhere(by_lenslet.any(axis=(2, 3, 4)))
        at = tuple(self._lenslets.T)
        self._by_lenslet = by_lenslet[at].reshape(len(self._lenslets), 2 * len(weights), -1)
        self._slopes_of_lenslet = slopes[at].reshape(len(self._lenslets), -1)
        # Lenslets beyond the edge have nodes with zero weights.
        lattice = np.arange(-1, n_sub + 1) - (n_sub - 1) / 2
        self.nodes_m = ((lattice[:, None] + nodes) * sub_aperture_m).ravel()
        self._first_y, self._first_x = (rows * k).astype(np.int64), (columns * k).astype(np.int64)
        self._tables_by_dtype: dict[str, NDArray[np.floating]] = {}

    def slopes(self, surfaces: NDArray[np.floating]) -> NDArray[np.floating]:
        """Slopes ``(n_slopes, n)`` of surfaces ``(n_nodes, n_nodes, n)`` at the nodes.

        Every node is weighted once per window, which is efficient for a few surfaces.
        """
        out = np.zeros((2, len(self._table), surfaces.shape[2]), surfaces.dtype)
        table = self._cast("windows", self._table, surfaces.dtype)
        _apply_to_surfaces(table, self._first_y, self._first_x, surfaces, out)
        return out.reshape(2 * len(self._table), -1)

    def sums_of_products(self, sums: Sequence[Products]) -> NDArray[np.floating]:
        """Slopes ``(n, n_slopes, n_act)`` of sums of products of functions of x and of y.

        All sums have equally many products, of functions ``(n_terms, n_nodes, n_act)`` at the nodes. The
        slopes are linear in the surfaces, so the weights are applied once per sum, and only where a sum is
        not negligible.
        """
        # Side by side: long rows are faster.
        x, y = (np.concatenate(parts, axis=2) for parts in zip(*sums, strict=True))
        dtype, k = x.dtype, self._table.shape[2] // _LENSLETS_ACROSS
        # Largest values on each column and row of lenslets.
        peaks_x, peaks_y = (np.abs(f).reshape(len(f), -1, k, f.shape[2]).max(axis=2) for f in (x, y))
        highest = (peaks_x.max(axis=1) * peaks_y.max(axis=1)).max(axis=0)
        negligible = _NEGLIGIBLE_SHARE * np.finfo(dtype).eps * highest
        out = np.zeros((2 * len(self._table), x.shape[2]), dtype)
        _apply_to_products(
            self._cast("lenslets", self._by_lenslet, dtype), self._slopes_of_lenslet, self._lenslets,
            x, y, peaks_x, peaks_y, negligible, out,
        )  # fmt: skip
        return np.asarray(out.reshape(len(out), len(sums), -1).transpose(1, 0, 2))

    def _cast(self, name: str, table: NDArray[np.float64], dtype: DTypeLike) -> NDArray[np.floating]:
        """A table in a precision, kept by its name."""
        key = name + np.dtype(dtype).str
        if key not in self._tables_by_dtype:
            self._tables_by_dtype[key] = np.ascontiguousarray(table, dtype=np.dtype(dtype))
        return self._tables_by_dtype[key]


def _lenslet_nodes(p: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Nodes ``(k,)`` within a lenslet of unit size, and interpolation ``(p, k)`` to its samples."""
    samples = (np.arange(p) - (p - 1) / 2) / p
    if p <= NODES:
        return samples, np.eye(p)
    nodes = np.polynomial.legendre.leggauss(NODES)[0] / 2
    interpolation = np.ones((p, NODES))
    for j in range(NODES):
        for i in range(NODES):
            if i != j:
                interpolation[:, j] *= (samples - nodes[i]) / (nodes[j] - nodes[i])
    return nodes, interpolation


@njit(cache=True, fastmath=True, nogil=True)
def _apply_to_surfaces(table, first_y, first_x, surfaces, out):  # type: ignore[no-untyped-def]  # pragma: no cover
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
def _apply_to_products(  # type: ignore[no-untyped-def]  # pragma: no cover
    table, slopes, lenslets, x, y, peaks_x, peaks_y, negligible, out
):
    """Weighted sums of ``sum_t y_t x_t`` into ``out (n_slopes, n_act)``, one lenslet after another.

    ``table (n_lenslets, n, n_nodes)`` has the weights of each lenslet's nodes, padded with zeros to a
    multiple of :data:`_AT_ONCE`, on the slopes numbered in ``slopes (n_lenslets, n)``, -1 for none.
    ``lenslets (n_lenslets, 2)`` has rows and columns. Actuators are skipped before the first and after the
    last whose product of ``peaks_x (n_terms, n_columns, n_act)`` and ``peaks_y (n_terms, n_rows, n_act)`` on
    the lenslet is above ``negligible (n_act,)``.
    """
    n_terms, _, n_act = x.shape
    n_weighted, n_nodes = table.shape[1:]
    k = x.shape[1] // peaks_x.shape[1]
    surface = np.zeros((n_nodes, n_act), x.dtype)
    for s in range(len(lenslets)):
        row, column = lenslets[s]
        first, last = n_act, 0
        for t in range(n_terms):
            for a in range(n_act):
                if peaks_x[t, column, a] * peaks_y[t, row, a] > negligible[a]:
                    first, last = min(first, a), max(last, a + 1)
        if first >= last:
            continue
        surface[: k * k, first:last] = 0
        for t in range(n_terms):
            for q in range(k):
                f = y[t, row * k + q, first:last]
                for r in range(k):
                    line, g = surface[q * k + r, first:last], x[t, column * k + r, first:last]
                    for a in range(line.size):
                        line[a] += f[a] * g[a]
        # Both slopes of a window, by :data:`_AT_ONCE` nodes: faster than a linear-algebra library.
        for i in range(0, n_weighted, 2):
            if slopes[s, i] < 0:
                continue
            along_x, along_y = out[slopes[s, i], first:last], out[slopes[s, i + 1], first:last]
            u, v = table[s, i], table[s, i + 1]
            for q in range(0, n_nodes, _AT_ONCE):
                f0, f1 = surface[q, first:last], surface[q + 1, first:last]
                f2, f3 = surface[q + 2, first:last], surface[q + 3, first:last]
                u0, u1, u2, u3 = u[q], u[q + 1], u[q + 2], u[q + 3]
                v0, v1, v2, v3 = v[q], v[q + 1], v[q + 2], v[q + 3]
                for a in range(along_x.size):
                    along_x[a] += u0 * f0[a] + u1 * f1[a] + u2 * f2[a] + u3 * f3[a]
                    along_y[a] += v0 * f0[a] + v1 * f1[a] + v2 * f2[a] + v3 * f3[a]
