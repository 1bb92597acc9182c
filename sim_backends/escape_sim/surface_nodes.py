"""Few nodes that carry a mirror surface as smooth as its influence functions."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

#: Nodes for each standard deviation of an influence function across half the pupil. The Chebyshev
#: coefficients of a Gaussian fall as ``exp(-(k sigma)^2 / 2)``: 6 leave 2e-7 at nominal width, 1e-5
#: at 0.8 of it.
_PER_SIGMA = 6.0


def surface_nodes(
    samples_m: NDArray[np.float64], sigma_m: float
) -> tuple[NDArray[np.float64], NDArray[np.float32] | None]:
    """Nodes along an axis, and the matrix from values there to values at the samples.

    Chebyshev nodes and barycentric interpolation (Berrut and Trefethen 2004), or the samples
    themselves where these are fewer.

    Parameters
    ----------
    samples_m
        Samples along the axis ``(n,)`` in metres, ascending.
    sigma_m
        Smallest standard deviation of an influence function in metres.

    Returns
    -------
    nodes_m : ndarray, ``(m,)``
    carry : ndarray, ``(n, m)``
        None where the nodes are the samples.
    """
    middle, half = (samples_m[0] + samples_m[-1]) / 2, (samples_m[-1] - samples_m[0]) / 2
    m = int(np.ceil(_PER_SIGMA * half / sigma_m)) + 1
    if m >= samples_m.size:
        return samples_m, None
    angle = (2 * np.arange(m) + 1) * np.pi / (2 * m)
    nodes = middle - half * np.cos(angle)
    weights = np.sin(angle) * (-1.0) ** np.arange(m)
    distance = samples_m[:, None] - nodes
    on_node = distance == 0
    share = weights / np.where(on_node, 1.0, distance)
    carry = share / share.sum(axis=1, keepdims=True)
    hit = on_node.any(axis=1)
    carry[hit] = on_node[hit]
    return nodes, carry.astype(np.float32)
