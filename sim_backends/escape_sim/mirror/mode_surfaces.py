"""Surfaces of modes under a registration and their derivatives; interpolation nodes for such surfaces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import DTypeLike, NDArray

from escape_hw.api.registration import Registration
from escape_sim.mirror.influence_functions import NEGLIGIBLE_BEYOND, InfluenceFunctions

#: Derivatives by the five parameters of the registration, in their order, and by the width.
N_DERIVATIVES = 6
#: Kinds of the factors along x and y in the derivatives by the positions and by the logarithms of the widths.
DERIVATIVE_KINDS = ((1, 0), (0, 1), (2, 0), (0, 2))
#: The same after those of the matrix itself.
MATRIX_AND_DERIVATIVE_KINDS = ((0, 0), *DERIVATIVE_KINDS)
#: Functions of x ``(n_terms, n_x, n_act)`` and of y ``(n_terms, n_y, n_act)``, whose products are summed.
Products = tuple[NDArray[np.floating], NDArray[np.floating]]


@dataclass(frozen=True, slots=True, eq=False)
class GaussianFactors:
    """Separable factors of all influence functions on a grid, and of their derivatives.

    The last axis has all actuators for each Gaussian of the profile in turn ``(n_terms * n_act,)``. With
    ``X_0 = exp(-u^2 / 2)``, ``u = (x - x_a) / s_x``, the derivative of a factor by the actuator's position is
    ``X_1 = X_0 u / s_x`` and by the logarithm of its width ``X_2 = X_0 u^2``.

    """

    #: ``X_0, X_1, X_2`` ``(3, n_x, n_terms * n_act)``, and the same along y ``(3, n_y, n_terms * n_act)``.
    along_x: NDArray[np.floating]
    along_y: NDArray[np.floating]
    #: Derivatives of the actuator positions ``(6, 2, n_act)`` as (x, y), metres per unit of the parameter.
    position: NDArray[np.floating]
    #: Derivatives of the logarithm of the widths along x and y ``(6, 2)``.
    log_width: NDArray[np.floating]

    @property
    def n_terms(self) -> int:
        """Number of Gaussians of the profile."""
        return int(self.along_x.shape[2] // self.position.shape[2])

    def terms(self, kind_x: int, kind_y: int) -> Products:
        """Factors of two kinds, one product per Gaussian."""
        x, y = (
            f.reshape(len(f), self.n_terms, -1).transpose(1, 0, 2)
            for f in (self.along_x[kind_x], self.along_y[kind_y])
        )
        return x, y

    def commands(self, m2c: NDArray[np.floating]) -> NDArray[np.floating]:
        """Commands of all Gaussians ``(n_terms * n_act, n_modes)`` for ``m2c (n_act, n_modes)``."""
        return np.tile(m2c, (self.n_terms, 1)).astype(self.along_x.dtype)


def gaussian_factors(
    influence: InfluenceFunctions,
    registration: Registration,
    sub_aperture_m: float,
    x_m: NDArray[np.float64],
    y_m: NDArray[np.float64],
    dtype: DTypeLike = np.float32,
    *,
    derivatives: bool = True,
) -> GaussianFactors:
    """Factors of influence functions of equal width and gain, and of their derivatives.

    The grid is given as for :meth:`InfluenceFunctions.factors`. Gain and shares are contained in the factors
    along y. Single precision gives 1e-6 of a surface. Without ``derivatives`` only ``X_0`` is computed.

    Raises
    ------
    ValueError
        The influence functions have one width or gain per actuator, or the registration has an anamorphosis
        angle.
    """
    if np.ndim(influence.width) or np.ndim(influence.gain):
        raise ValueError("derivatives need influence functions of equal width and gain")
    if registration.anamorphosis_angle:
        raise ValueError(
            f"the anamorphosis angle is {registration.anamorphosis_angle}; derivatives need an angle of 0"
        )
    at = influence.registered_positions(registration, sub_aperture_m)
    shares, scales = np.repeat(np.transpose(influence.profile), influence.n_act, axis=1)
    at = np.tile(at, (len(influence.profile), 1))
    sigma = scales * (
        float(influence.width) * influence.pitch_m / np.sqrt(2 * np.log(1 / influence.coupling))
    )
    stretch = 1 + np.array([registration.radial_scaling, registration.tangential_scaling]) / 100
    n_kinds = 3 if derivatives else 1
    along_x, along_y = (np.empty((n_kinds, len(at_m), len(at)), dtype) for at_m in (x_m, y_m))
    _fill_factors(x_m, at[:, 0], sigma * stretch[0], np.ones(len(at)), along_x)
    _fill_factors(y_m, at[:, 1], sigma * stretch[1], float(influence.gain) * shares, along_y)
    position, log_width = np.zeros((N_DERIVATIVES, 2, influence.n_act)), np.zeros((N_DERIVATIVES, 2))
    if derivatives:
        position, log_width = _parameter_derivatives(influence, registration, sub_aperture_m, stretch)
    return GaussianFactors(along_x, along_y, position.astype(dtype), log_width)


@njit(cache=True, nogil=True)
def _fill_factors(coordinates, positions, sigma, factor, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """``factor X_0``, and with three kinds ``factor X_1`` and ``factor X_2``, into ``out (kinds, n, n_act)``.

    Zero far out, as :func:`~.influence_functions.gaussian` is.
    """
    out[:] = 0
    for i in range(coordinates.size):
        for a in range(positions.size):
            u = (coordinates[i] - positions[a]) / sigma[a]
            if u * u < NEGLIGIBLE_BEYOND:
                gauss = factor[a] * np.exp(-0.5 * u * u)
                out[0, i, a] = gauss
                if len(out) > 1:
                    out[1, i, a], out[2, i, a] = gauss * u / sigma[a], gauss * u * u


def _parameter_derivatives(
    influence: InfluenceFunctions,
    registration: Registration,
    sub_aperture_m: float,
    stretch: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Derivatives of positions and log widths by the parameters, from ``Registration.affine``."""
    matrix, _ = registration.affine(sub_aperture_m)
    rotation = matrix / stretch
    nominal = influence.positions_m.T
    quarter_turn = np.array([[0.0, -1.0], [1.0, 0.0]])
    position = np.zeros((N_DERIVATIVES, 2, influence.n_act))
    position[0, 0] = position[1, 1] = sub_aperture_m / 100
    position[2] = np.deg2rad(1.0) * quarter_turn @ matrix @ nominal
    position[3] = rotation[:, :1] * nominal[:1] / 100
    position[4] = rotation[:, 1:] * nominal[1:] / 100
    log_width = np.zeros((N_DERIVATIVES, 2))
    log_width[3, 0], log_width[4, 1] = 0.01 / stretch
    log_width[5] = 1 / float(influence.width)
    return position, log_width


def combine_derivatives(
    position: NDArray[np.floating], log_width: NDArray[np.floating], parts: NDArray[np.floating]
) -> NDArray[np.float64]:
    """Derivatives by the parameters ``(6, n_slopes, n_act)`` from ``parts (4, n_slopes, n_act)``.

    The parts are the derivatives by the positions along x and y and by the logarithms of the widths.
    """
    out = np.empty((N_DERIVATIVES, *parts.shape[1:]))
    for p, ((along_x, along_y), (width_x, width_y)) in enumerate(zip(position, log_width, strict=True)):
        out[p] = parts[0] * along_x + parts[1] * along_y
        if width_x:
            out[p] += parts[2] * width_x
        if width_y:
            out[p] += parts[3] * width_y
    return out


def mode_surfaces(factors: GaussianFactors, m2c: NDArray[np.floating]) -> NDArray[np.floating]:
    """Surfaces of modes ``(n_y, n_x, n_modes)`` in fractions of full stroke, for ``m2c (n_act, n_modes)``."""
    return _product(factors.along_y[0], factors.along_x[0], factors.commands(m2c))


def mode_derivatives(factors: GaussianFactors, m2c: NDArray[np.floating]) -> NDArray[np.floating]:
    """Surfaces of modes and their derivatives ``(n_y, n_x, 1 + 6, n_modes)``, the surfaces first."""
    x, y = factors.along_x, factors.along_y
    c = factors.commands(m2c)
    position = np.tile(factors.position, factors.n_terms)
    out = np.empty((y.shape[1], x.shape[1], 1 + N_DERIVATIVES, c.shape[1]), x.dtype)
    out[:, :, 0] = _product(y[0], x[0], c)
    for p in range(N_DERIVATIVES):
        (shift_x, shift_y), (width_x, width_y) = position[p], factors.log_width[p].astype(x.dtype)
        total = out[:, :, 1 + p]
        total[...] = 0
        if shift_x.any() or width_x:
            total += _product(y[0], x[1] * shift_x + x[2] * width_x, c)
        if shift_y.any() or width_y:
            total += _product(y[1] * shift_y + y[2] * width_y, x[0], c)
    return out


def _product(
    along_y: NDArray[np.floating], along_x: NDArray[np.floating], c: NDArray[np.floating]
) -> NDArray[np.floating]:
    """``sum_a y_a x_a c_am`` as one matrix product ``(n_y, n_x, n_modes)``."""
    n_act, n_modes = c.shape
    right = (along_x.T[:, :, None] * c[:, None, :]).reshape(n_act, -1)
    return (along_y @ right).reshape(along_y.shape[0], along_x.shape[0], n_modes)


#: Nodes per standard deviation of an influence function across half the pupil. The Chebyshev
#: coefficients of a Gaussian fall as ``exp(-(k sigma)^2 / 2)``: with 7 the error of a pyramid's slopes is
#: below 1e-6 at nominal width, 4e-5 at 0.6 and 2 % at 0.35 of it, which is a tenth of a profile at most.
_NODES_PER_SIGMA = 7.0


def surface_nodes(
    samples_m: NDArray[np.float64], sigma_m: float
) -> tuple[NDArray[np.float64], NDArray[np.float32] | None]:
    """Interpolation nodes along an axis, and the matrix from their values to values at the samples.

    Chebyshev nodes with barycentric interpolation (Berrut and Trefethen 2004), or the samples
    themselves, with None for the matrix, if these are fewer.

    Parameters
    ----------
    samples_m
        Samples along the axis ``(n,)`` in metres, ascending.
    sigma_m
        Smallest standard deviation of an influence function in metres.

    Returns
    -------
    nodes_m, interpolation : ndarray, ``(m,)`` and ``(n, m)``
    """
    centre, half = (samples_m[0] + samples_m[-1]) / 2, (samples_m[-1] - samples_m[0]) / 2
    m = int(np.ceil(_NODES_PER_SIGMA * half / sigma_m)) + 1
    if m >= samples_m.size:
        return samples_m, None
    angle = (2 * np.arange(m) + 1) * np.pi / (2 * m)
    nodes = centre - half * np.cos(angle)
    weights = np.sin(angle) * (-1.0) ** np.arange(m)
    distance = samples_m[:, None] - nodes
    on_node = distance == 0
    share = weights / np.where(on_node, 1.0, distance)
    interpolation = share / share.sum(axis=1, keepdims=True)
    exact = on_node.any(axis=1)
    interpolation[exact] = on_node[exact]
    return nodes, interpolation.astype(np.float32)
