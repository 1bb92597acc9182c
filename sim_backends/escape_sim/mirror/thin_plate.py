"""Influence functions of a thin plate with free edges on springs at its actuators.

The plate minimises its bending energy plus that of the springs (Timoshenko & Woinowsky-Krieger 1959, section
21):
``D/2 integral [w_xx^2 + w_yy^2 + 2 nu w_xx w_yy + 2 (1 - nu) w_xy^2] + sum_a k/2 (w(x_a) - c_a)^2``. Finite
differences of the energy give free edges without further conditions. Unlike Gaussians these functions have a
negative ring, and those of edge actuators have another shape.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from scipy.optimize import brentq
from scipy.sparse import csr_matrix, diags
from scipy.sparse.linalg import splu

if TYPE_CHECKING:
    from collections.abc import Callable

#: Poisson's ratio of glass and of most membranes is about this.
_POISSON_RATIO = 0.25
#: Grid points per pitch, and default width of the plate beyond the outermost actuators in pitches.
_POINTS_PER_PITCH, RIM = 6, 0.6
#: Range of the spring constant in units of ``D / pitch^2`` that is searched for a coupling.
_SPRING_RANGE = 1e-2, 1e4


def thin_plate_surfaces(
    positions: NDArray[np.float64], coupling: float, rim: float = RIM
) -> tuple[NDArray[np.float64], float]:
    """Influence functions of a plate whose central actuator has a given coupling.

    Parameters
    ----------
    positions
        Positions of the actuators ``(n_act, 2)`` as (x, y) in pitches.
    coupling
        Surface of the central actuator at its nearest neighbour, relative to its own.
    rim
        Width of the plate beyond the outermost actuators in pitches.

    Returns
    -------
    surfaces : ndarray, ``(n_act, n, n)``
        Per unit command of a peak of 1 at the central actuator; beyond the plate the nearest value.
    pixel : float
        Distance of the points in pitches.

    Raises
    ------
    ValueError
        No stiffness of the springs gives this coupling.
    """
    pixel = 1 / _POINTS_PER_PITCH
    radius = float(np.linalg.norm(positions, axis=1).max()) + rim
    half = int(np.ceil(radius / pixel)) + 2
    axis = np.arange(-half, half + 1) * pixel
    inside = axis[:, None] ** 2 + axis**2 <= radius**2
    number = np.full(inside.shape, -1)
    number[inside] = np.arange(int(inside.sum()))
    stiffness = _bending_stiffness(number, pixel)
    at_actuators = _interpolation(number, positions / pixel + half)
    centre = int(np.argmin(np.linalg.norm(positions, axis=1)))
    distance = np.linalg.norm(positions - positions[centre], axis=1)
    neighbour = int(np.argsort(distance)[1])

    def response(log_spring: float) -> NDArray[np.float64]:
        spring = np.exp(log_spring)
        factor = splu((stiffness + spring * at_actuators.T @ at_actuators).tocsc())
        return np.asarray(factor.solve(spring * at_actuators.T.toarray()))

    def excess(log_spring: float) -> float:
        heights = at_actuators[[centre, neighbour]] @ response(log_spring)[:, centre]
        return float(heights[1] / heights[0] - coupling)

    solution = response(_solve_spring(excess, coupling))
    peak = float((at_actuators[[centre]] @ solution[:, centre])[0])
    nearest = distance_transform_edt(~inside, return_distances=False, return_indices=True)
    surfaces = np.stack([solution[number[tuple(nearest)], a] for a in range(len(positions))])
    return surfaces / peak, pixel


def _solve_spring(excess: Callable[[float], float], coupling: float) -> float:
    try:
        return float(brentq(excess, *np.log(_SPRING_RANGE), xtol=1e-3))
    except ValueError as error:
        raise ValueError(f"no thin plate on springs has a coupling of {coupling}; use 0.1 to 0.6") from error


def _bending_stiffness(number: NDArray[np.intp], pixel: float) -> Any:
    """Matrix of the quadratic bending energy at unit flexural rigidity, for points ``number >= 0``."""
    second = (1.0, -2.0, 1.0)
    along_x = _stencil(number, [(0, -1), (0, 0), (0, 1)], second)
    along_y = _stencil(number, [(-1, 0), (0, 0), (1, 0)], second)
    twist = _stencil(number, [(0, 0), (0, 1), (1, 0), (1, 1)], (1.0, -1.0, -1.0, 1.0))
    both = _stencil(number, [(0, -1), (0, 0), (0, 1), (-1, 0), (0, 0), (1, 0)], (*second, *second))
    # w_xx^2 + w_yy^2 + 2 nu w_xx w_yy = (1 - nu) (w_xx^2 + w_yy^2) + nu (w_xx + w_yy)^2
    nu = _POISSON_RATIO
    energy = (1 - nu) * (along_x.T @ along_x + along_y.T @ along_y + 2 * twist.T @ twist) + nu * both.T @ both
    # A rigid motion has no energy; where no spring holds a corner point, this does.
    return energy / pixel**2 + 1e-9 * diags(np.ones(energy.shape[0]))


def _stencil(number: NDArray[np.intp], steps: list[tuple[int, int]], weights: tuple[float, ...]) -> Any:
    """Differences at all points whose neighbours ``steps`` exist, as a sparse matrix."""
    rows, columns = np.nonzero(number >= 0)
    neighbours = np.stack([number[rows + down, columns + right] for down, right in steps], axis=1)
    complete = neighbours[(neighbours >= 0).all(axis=1)]
    n = len(complete)
    data = np.tile(weights, n)
    at = (np.repeat(np.arange(n), len(steps)), complete.ravel())
    return csr_matrix((data, at), shape=(n, int(number.max()) + 1))


def _interpolation(number: NDArray[np.intp], at: NDArray[np.float64]) -> Any:
    """Bilinear interpolation at pixel coordinates ``(n, 2)`` as (x, y), as a sparse matrix."""
    corner = np.floor(at).astype(int)
    share = at - corner
    rows, columns, data = [], [], []
    for right in (0, 1):
        for down in (0, 1):
            weight = np.abs(1 - right - share[:, 0]) * np.abs(1 - down - share[:, 1])
            rows.append(np.arange(len(at)))
            columns.append(number[corner[:, 1] + down, corner[:, 0] + right])
            data.append(weight)
    shape = (len(at), int(number.max()) + 1)
    return csr_matrix((np.concatenate(data), (np.concatenate(rows), np.concatenate(columns))), shape=shape)
