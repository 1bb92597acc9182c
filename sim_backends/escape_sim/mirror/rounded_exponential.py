"""Influence functions shaped as those of membrane mirrors: rounded exponentials that differ between actuators."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.registration import Registration


@dataclass(frozen=True, slots=True, eq=False)
class ExponentialInfluenceFunctions:
    """Rounded exponentials, one set of parameters per actuator.

    The surface per unit command at a distance of ``r`` pitches in the direction ``theta`` is ``gain (1 + s u)
    (1 + f t cos 4 theta) exp(-(sqrt(r^2 + w^2) - w) / L)`` with the distance ``u`` along ``outward`` in pitches,
    limited to one, and ``t = r^4 / (r^2 + w^2)^2``. Scalings and rotation of a registration act on the whole
    surface, shapes included.

    Parameters
    ----------
    positions_m
        Positions ``(n_act, 2)`` as (x, y) on the pupil in metres.
    pitch_m
        Actuator pitch on the pupil in metres.
    length, rounding
        ``L`` and ``w`` in pitches ``(n_act,)``.
    gain
        Gain of each actuator ``(n_act,)``.
    fourfold
        ``f``, the four-fold term ``(n_act,)``.
    slope
        ``s``, the relative asymmetry per pitch outwards ``(n_act,)``.
    """

    positions_m: NDArray[np.float64]
    pitch_m: float
    length: NDArray[np.float64]
    rounding: NDArray[np.float64]
    gain: NDArray[np.float64]
    fourfold: NDArray[np.float64]
    slope: NDArray[np.float64]

    @property
    def n_act(self) -> int:
        """Number of actuators."""
        return len(self.positions_m)

    def surfaces(
        self,
        registration: Registration,
        sub_aperture_m: float,
        x_m: NDArray[np.float64],
        y_m: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """Surfaces per unit command ``(n_act, n_y, n_x)``, fractions of full stroke."""
        matrix, offset = registration.affine(sub_aperture_m)
        inverse = np.linalg.inv(matrix) / self.pitch_m
        x, y = x_m - offset[0], y_m - offset[1]
        out = np.empty((self.n_act, y_m.size, x_m.size))
        outward = self.positions_m / np.maximum(np.linalg.norm(self.positions_m, axis=1), 1e-12)[:, None]
        for a, position in enumerate(self.positions_m / self.pitch_m):
            u = inverse[0, 0] * x + inverse[0, 1] * y[:, None] - position[0]
            v = inverse[1, 0] * x + inverse[1, 1] * y[:, None] - position[1]
            r2 = u**2 + v**2
            rounded2 = r2 + self.rounding[a] ** 2
            profile = np.exp(-(np.sqrt(rounded2) - self.rounding[a]) / self.length[a])
            if self.fourfold[a]:
                # r^4 cos(4 theta) as a polynomial.
                profile *= 1 + self.fourfold[a] * (u**4 - 6 * u**2 * v**2 + v**4) / rounded2**2
            if self.slope[a]:
                along = u * outward[a, 0] + v * outward[a, 1]
                profile *= 1 + self.slope[a] * np.clip(along, -1, 1)
            out[a] = self.gain[a] * profile
        return out


def edge_actuators(positions_m: NDArray[np.float64], pitch_m: float) -> NDArray[np.bool_]:
    """Actuators with fewer than the usual number of neighbours within 1.3 pitches ``(n_act,)``."""
    distance = np.linalg.norm(positions_m[:, None] - positions_m, axis=2)
    neighbours = (distance < 1.3 * pitch_m).sum(axis=1)
    return np.asarray(neighbours < np.median(neighbours))


def draw_alpao_like(
    positions_m: NDArray[np.float64], pitch_m: float, rng: np.random.Generator
) -> ExponentialInfluenceFunctions:
    """Draw a mirror as the measured ALPAO DM97-15 mirrors are.

    Lengths of 0.75 to 1.05 pitches, 2 % scatter between actuators and 5 % more at the edge; roundings of 0.18 to
    0.35; a four-fold term of -2 to 4 %; gains that scatter by 6 to 9 %, at the edge 12 % larger; edge actuators
    6 % per pitch higher outwards; positions to 1 % of the pitch.
    """
    n, edge = len(positions_m), edge_actuators(positions_m, pitch_m)
    length = rng.uniform(0.75, 1.05) * (1 + 0.02 * rng.standard_normal(n)) * np.where(edge, 1.05, 1.0)
    rounding = np.full(n, rng.uniform(0.18, 0.35))
    fourfold = np.full(n, rng.uniform(-0.02, 0.04))
    gain = (1 + rng.uniform(0.06, 0.09) * rng.standard_normal(n)) * np.where(edge, 1.12, 1.0)
    positions = positions_m + 0.01 * pitch_m * rng.standard_normal((n, 2))
    return ExponentialInfluenceFunctions(
        positions, pitch_m, length, rounding, gain, fourfold, np.where(edge, 0.06, 0.0)
    )
