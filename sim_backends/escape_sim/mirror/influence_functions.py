"""Influence functions of a deformable mirror under any registration, as sums of Gaussians."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import NDArray
from scipy import optimize
from scipy.special import factorial

from escape_hw.api.registration import Registration
from escape_hw.api.synthetic_model import PROFILE_WIDTHS

if TYPE_CHECKING:
    from escape_hw.config.system import SystemConfig

#: Terms of a series below this share of an influence function's peak are omitted.
_NEGLIGIBLE = 1e-13
#: Profile of a single Gaussian of nominal width: share and relative width of each Gaussian.
SINGLE_GAUSSIAN = ((1.0, 1.0),)
#: Radius in pitches and samples of the profiles that Gaussians are fitted to.
_PROFILE_RADIUS, _PROFILE_SAMPLES = 5.0, 500


def actuator_positions(config: SystemConfig) -> NDArray[np.float64]:
    """Nominal actuator positions ``(n_act, 2)`` as (x, y) in metres on the pupil."""
    return config.devices.dm.positions() * pitch_on_pupil(config)


def pitch_on_pupil(config: SystemConfig) -> float:
    """Actuator pitch in metres, as relayed onto the pupil."""
    return config.system.pupil_m / config.devices.dm.pitches_across_pupil


#: Square beyond which a Gaussian, 1e-12 there, is zero.
NEGLIGIBLE_BEYOND = 55.0


def gaussian(square: NDArray[np.float64]) -> NDArray[np.float64]:
    """``exp(-square / 2)``, exactly zero far out.

    Subnormal numbers, of which products of two such factors would be full in single precision, make matrix
    products up to sixty times slower on some processors.
    """
    return np.where(square < NEGLIGIBLE_BEYOND, np.exp(-0.5 * square), 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class InfluenceFunctions:
    """Influence functions with a radial profile that is a sum of Gaussians.

    The surface per unit command is ``sum_k share_k G(scale_k s_i)`` times the actuator's gain, where ``G(s)``
    is a Gaussian of peak 1 whose nominal width falls to ``coupling`` at one pitch. As in OOPAO
    (``DeformableMirror.modesComputation``), scalings stretch the shapes and the positions; rotation
    moves the actuators without rotating their shapes.

    Parameters
    ----------
    positions_m
        Nominal positions ``(n_act, 2)`` as (x, y) on the pupil in metres.
    pitch_m
        Actuator pitch on the pupil in metres.
    coupling
        Relative surface of a single Gaussian one pitch away, which sets the scale of all widths.
    width, gain
        Factor on the width of the Gaussian, and gain: one number or one per actuator ``(n_act,)``.
    profile
        Share and relative width of each Gaussian.
    """

    positions_m: NDArray[np.float64]
    pitch_m: float
    coupling: float
    width: float | NDArray[np.float64] = 1.0
    gain: float | NDArray[np.float64] = 1.0
    profile: tuple[tuple[float, float], ...] = SINGLE_GAUSSIAN

    @property
    def n_act(self) -> int:
        """Number of actuators."""
        return len(self.positions_m)

    def with_width(self, width: float) -> Self:
        """The same functions, ``width`` times as wide."""
        return replace(self, width=width)

    def with_gain(self, gain: NDArray[np.float64]) -> Self:
        """The same functions with these gains ``(n_act,)``."""
        return replace(self, gain=gain)

    def registered_positions(self, registration: Registration, sub_aperture_m: float) -> NDArray[np.float64]:
        """Positions ``(n_act, 2)`` in metres under a registration."""
        matrix, offset = registration.affine(sub_aperture_m)
        return np.asarray(self.positions_m @ matrix.T + offset)

    def factors(
        self,
        registration: Registration,
        sub_aperture_m: float,
        x_m: NDArray[np.float64],
        y_m: NDArray[np.float64],
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Separable factors of the surfaces on a grid.

        Parameters
        ----------
        registration, sub_aperture_m
            Registration and the size of a sub-aperture in metres that its shifts refer to.
        x_m, y_m
            Columns' and rows' coordinates ``(n_x,)`` and ``(n_y,)`` in metres.

        Returns
        -------
        along_x, along_y : ndarray, ``(n_x, n_act, n_terms)`` and ``(n_y, n_act, n_terms)``
            The surface of actuator ``a`` is ``sum_t along_y[:, a, t] x along_x[:, a, t]``. One term per
            Gaussian, and about a dozen times as many with an anamorphosis angle, whose ellipse is not a
            product of functions of x and y.
        """
        at = self.registered_positions(registration, sub_aperture_m)
        sigma = np.broadcast_to(
            np.asarray(self.width) * self.pitch_m / np.sqrt(2 * np.log(1 / self.coupling)), (self.n_act,)
        )
        # exp(-(d, Q d) / (2 sigma^2)) with Q = S^-2: the shapes are stretched as the positions.
        inverse = np.linalg.inv(registration.scaling_matrix)
        q = inverse @ inverse
        dx = (x_m[:, None] - at[:, 0]) / sigma
        dy = (y_m[:, None] - at[:, 1]) / sigma
        gain = np.broadcast_to(np.asarray(self.gain, dtype=float), (self.n_act,))
        x, y = [], []
        for share, scale in self.profile:
            u, v = dx / scale, dy / scale
            gauss_x, gauss_y = gaussian(q[0, 0] * u**2), share * gain * gaussian(q[1, 1] * v**2)
            for power, weight in enumerate(_cross_term_weights(q)):
                x.append(gauss_x * u**power if power else gauss_x)
                y.append(gauss_y * (weight * v**power) if power else gauss_y)
        return np.stack(x, axis=2), np.stack(y, axis=2)

    def surfaces(
        self,
        registration: Registration,
        sub_aperture_m: float,
        x_m: NDArray[np.float64],
        y_m: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """Surfaces per unit command ``(n_act, n_y, n_x)``, fractions of full stroke."""
        along_x, along_y = self.factors(registration, sub_aperture_m, x_m, y_m)
        return np.asarray(np.einsum("yat,xat->ayx", along_y, along_x))


def exponential_length(coupling: float, rounding: float) -> float:
    """Length ``L`` in pitches of a rounded exponential ``exp(-(sqrt(r^2 + w^2) - w) / L)`` of a coupling."""
    return float((np.hypot(1, rounding) - rounding) / -np.log(coupling))


def exponential_profile(coupling: float, rounding: float) -> tuple[tuple[float, float], ...]:
    """Sum of Gaussians that approximates a rounded exponential.

    A rounded exponential is a positive sum of Gaussians, because it is a completely monotone function of
    ``r^2`` (Bernstein's theorem). The shares of the widths
    :data:`~escape_hw.api.synthetic_model.PROFILE_WIDTHS` minimise the error of the slope over the area within
    five pitches: about 1 % of its rms.

    Parameters
    ----------
    coupling
        Relative surface one pitch away.
    rounding
        Radius ``w`` of the rounded tip in pitches.
    """
    radius = np.linspace(0, _PROFILE_RADIUS, _PROFILE_SAMPLES)
    hypotenuse, length = np.hypot(radius, rounding), exponential_length(coupling, rounding)
    slope = radius / hypotenuse / length * np.exp(-(hypotenuse - rounding) / length)
    sigma = np.asarray(PROFILE_WIDTHS) / np.sqrt(2 * np.log(1 / coupling))
    gaussians = radius[:, None] / sigma**2 * np.exp(-0.5 * np.square(radius[:, None] / sigma))
    area = np.sqrt(radius)
    shares, _ = optimize.nnls(area[:, None] * gaussians, area * slope)
    return tuple((float(s), width) for s, width in zip(shares, PROFILE_WIDTHS, strict=True) if s > 0)


def _cross_term_weights(q: NDArray[np.float64]) -> NDArray[np.float64]:
    """Weights ``(n,)`` of the powers of ``u v`` in ``exp(-q_xy u v)``.

    Relative to ``exp(-q_xx u^2 / 2 - q_yy v^2 / 2)`` the k-th term is at most ``r^k / sqrt(2 pi k)`` with
    ``r = |q_xy| / sqrt(q_xx q_yy)``, which is far below one for nearly equal scalings.
    """
    ratio = abs(q[0, 1]) / np.sqrt(q[0, 0] * q[1, 1])
    if ratio < _NEGLIGIBLE:
        return np.ones(1)
    k = np.arange(1 + int(np.ceil(np.log(_NEGLIGIBLE) / np.log(ratio))))
    return np.asarray((-q[0, 1]) ** k / factorial(k))
