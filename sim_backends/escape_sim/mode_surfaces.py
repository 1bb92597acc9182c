"""Mode surfaces under a registration, and their derivatives by it, as sums of separable products.

A Gaussian influence function is a product of a factor along x and one along y. A mode, which is a
weighted sum of them, is then one matrix product ``Y diag(c) X^T``, and so is each part of its
derivatives: no surface of a single actuator is ever formed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import DTypeLike, NDArray

from escape_hw.api.registration import Registration
from escape_sim.influence import InfluenceFunctions

#: Derivatives are by the five parameters of the registration, in their order, and by the width.
N_DERIVATIVES = 6


@dataclass(frozen=True, slots=True, eq=False)
class GaussianFactors:
    """Factors of all influence functions on a grid, with what their derivatives are made of.

    With ``X_0 = exp(-u^2 / 2)``, ``u = (x - x_a) / s_x``, the derivative of a factor by the
    actuator's place is ``X_1 = X_0 u / s_x`` and by the logarithm of its width ``X_2 = X_0 u^2``.

    Parameters
    ----------
    along_x, along_y
        ``(3, n_x, n_act)`` and ``(3, n_y, n_act)``: ``X_0, X_1, X_2`` and the same along y.
    place
        Derivatives of the actuators' places ``(6, 2, n_act)`` as (x, y), in metres per unit of the
        parameter.
    spread
        Derivatives of the logarithm of the widths along x and y ``(6, 2)``.
    """

    along_x: NDArray[np.floating]
    along_y: NDArray[np.floating]
    place: NDArray[np.floating]
    spread: NDArray[np.floating]


def gaussian_factors(
    influence: InfluenceFunctions,
    registration: Registration,
    sub_aperture_m: float,
    x_m: NDArray[np.float64],
    y_m: NDArray[np.float64],
    dtype: DTypeLike = np.float32,
) -> GaussianFactors:
    """Factors and derivatives of influence functions without a wing.

    Parameters
    ----------
    influence
        The influence functions; the gain is contained in the factors along y.
    registration, sub_aperture_m
        Registration and the size of a sub-aperture in metres that its shifts refer to.
    x_m, y_m
        Columns' and rows' coordinates ``(n_x,)`` and ``(n_y,)`` in metres.
    dtype
        Precision of the factors; single precision is worth 1e-6 of a surface.

    Raises
    ------
    ValueError
        The influence functions have a wing, or one width or gain per actuator; or the registration
        has an anamorphosis angle.
    """
    if influence.wing or np.ndim(influence.width) or np.ndim(influence.gain):
        raise ValueError("derivatives are known for equal Gaussian influence functions without a wing only")
    if registration.anamorphosis_angle:
        raise ValueError("derivatives are known without an anamorphosis angle only; no solver asks for one")
    at = influence.placed(registration, sub_aperture_m)
    sigma = float(influence.width) * influence.pitch_m / np.sqrt(2 * np.log(1 / influence.coupling))
    stretch = 1 + np.array([registration.radial_scaling, registration.tangential_scaling]) / 100
    both = []
    for coordinates, place, s in ((x_m, at[:, 0], sigma * stretch[0]), (y_m, at[:, 1], sigma * stretch[1])):
        u = (coordinates[:, None] - place) / s
        first = np.exp(-0.5 * np.square(u))
        both.append(np.stack([first, first * u / s, first * np.square(u)]))
    both[1] *= float(influence.gain)
    place, spread = _moves(influence, registration, sub_aperture_m, stretch)
    return GaussianFactors(both[0].astype(dtype), both[1].astype(dtype), place.astype(dtype), spread)


def _moves(
    influence: InfluenceFunctions,
    registration: Registration,
    sub_aperture_m: float,
    stretch: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """How places and widths follow the parameters, from ``Registration.affine``."""
    matrix, _ = registration.affine(sub_aperture_m)
    turn = matrix / stretch
    nominal = influence.positions_m.T
    quarter = np.array([[0.0, -1.0], [1.0, 0.0]])
    place = np.zeros((N_DERIVATIVES, 2, influence.n_act))
    place[0, 0] = place[1, 1] = sub_aperture_m / 100
    place[2] = np.deg2rad(1.0) * quarter @ matrix @ nominal
    place[3] = turn[:, :1] * nominal[:1] / 100
    place[4] = turn[:, 1:] * nominal[1:] / 100
    spread = np.zeros((N_DERIVATIVES, 2))
    spread[3, 0], spread[4, 1] = 0.01 / stretch
    spread[5] = 1 / float(influence.width)
    return place, spread


def mode_surfaces(factors: GaussianFactors, m2c: NDArray[np.floating]) -> NDArray[np.floating]:
    """Surfaces of modes ``(n_y, n_x, n_modes)`` in fractions of full stroke.

    Parameters
    ----------
    factors
        From :func:`gaussian_factors`.
    m2c
        Mode-to-command matrix ``(n_act, n_modes)``.
    """
    return _product(factors.along_y[0], factors.along_x[0], m2c.astype(factors.along_x.dtype))


def mode_derivatives(factors: GaussianFactors, m2c: NDArray[np.floating]) -> NDArray[np.floating]:
    """Surfaces of modes and their derivatives ``(n_y, n_x, 1 + 6, n_modes)``, the surfaces first.

    Parameters
    ----------
    factors
        From :func:`gaussian_factors`.
    m2c
        Mode-to-command matrix ``(n_act, n_modes)``.
    """
    x, y = factors.along_x, factors.along_y
    c = m2c.astype(x.dtype)
    out = np.empty((y.shape[1], x.shape[1], 1 + N_DERIVATIVES, c.shape[1]), x.dtype)
    out[:, :, 0] = _product(y[0], x[0], c)
    for p in range(N_DERIVATIVES):
        (in_x, in_y), (wide_x, wide_y) = factors.place[p], factors.spread[p].astype(x.dtype)
        total = out[:, :, 1 + p]
        total[...] = 0
        if in_x.any() or wide_x:
            total += _product(y[0], x[1] * in_x + x[2] * wide_x, c)
        if in_y.any() or wide_y:
            total += _product(y[1] * in_y + y[2] * wide_y, x[0], c)
    return out


def _product(
    along_y: NDArray[np.floating], along_x: NDArray[np.floating], c: NDArray[np.floating]
) -> NDArray[np.floating]:
    """``sum_a y_a x_a c_am`` as one matrix product ``(n_y, n_x, n_modes)``."""
    n_act, n_modes = c.shape
    right = (along_x.T[:, :, None] * c[:, None, :]).reshape(n_act, -1)
    return (along_y @ right).reshape(along_y.shape[0], along_x.shape[0], n_modes)
