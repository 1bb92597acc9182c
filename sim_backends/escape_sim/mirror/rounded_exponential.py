"""Influence functions as of membrane mirrors: rounded exponentials that differ between actuators."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from escape_hw.api.registration import Registration
from escape_sim.mirror.influence_functions import exponential_length


@dataclass(frozen=True, slots=True, eq=False)
class ExponentialInfluenceFunctions:
    """Rounded exponentials, one set of parameters per actuator.

    The surface per unit command at a distance of ``r`` pitches in the direction ``theta`` is ``gain (1 + s u)
    (1 + f t cos 4 theta) exp(-(sqrt(r^2 + w^2) - w) / L)`` with the distance ``u`` outwards in pitches and
    ``t = r^4 / (r^2 + w^2)^2``. Scalings and rotation of a registration act on the whole surface, shapes
    included.

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
        outward = self.positions_m / np.maximum(np.linalg.norm(self.positions_m, axis=1), 1e-12)[:, None]
        out = np.empty((self.n_act, y_m.size, x_m.size))
        _fill_surfaces(
            x_m - offset[0], y_m - offset[1], inverse, self.positions_m / self.pitch_m, outward, self.length,
            self.rounding, self.gain, self.fourfold, self.slope, out,
        )  # fmt: skip
        return out


@njit(cache=True, fastmath=True, nogil=True)
def _fill_surfaces(  # type: ignore[no-untyped-def]  # pragma: no cover
    x, y, inverse, position, outward, length, rounding, gain, fourfold, slope, out
):
    for a in range(out.shape[0]):
        w = rounding[a]
        for i in range(y.size):
            for j in range(x.size):
                u = inverse[0, 0] * x[j] + inverse[0, 1] * y[i] - position[a, 0]
                v = inverse[1, 0] * x[j] + inverse[1, 1] * y[i] - position[a, 1]
                u2, v2 = u * u, v * v
                rounded2 = u2 + v2 + w * w
                profile = gain[a] * math.exp((w - math.sqrt(rounded2)) / length[a])
                # r^4 cos(4 theta) as a polynomial.
                fourth = (u2 * u2 - 6 * u2 * v2 + v2 * v2) / (rounded2 * rounded2)
                outwards = u * outward[a, 0] + v * outward[a, 1]
                out[a, i, j] = profile * (1 + fourfold[a] * fourth) * (1 + slope[a] * outwards)


#: Ranges of the measured ALPAO DM97-15 mirrors: length and rounding in pitches, four-fold term.
_LENGTH, _ROUNDING, _FOURFOLD = (0.75, 1.05), (0.18, 0.35), (-0.02, 0.04)
#: Their edge actuators: relative length and gain beyond the others, and asymmetry per pitch outwards.
_EDGE_LENGTH, _EDGE_GAIN, _EDGE_SLOPE = 0.05, 0.12, 0.06
#: Width of the ring of edge actuators in pitches.
_EDGE_RING = 0.75
#: Scatter of the positions in pitches.
_POSITION_SCATTER = 0.01


def draw_exponential(
    positions_m: NDArray[np.float64],
    pitch_m: float,
    rng: np.random.Generator,
    *,
    gain_scatter: float,
    length_scatter: float,
    coupling: float | None = None,
) -> ExponentialInfluenceFunctions:
    """Draw a mirror as the measured ALPAO DM97-15 mirrors are.

    Parameters
    ----------
    positions_m, pitch_m
        Nominal positions ``(n_act, 2)`` as (x, y) and pitch on the pupil in metres.
    rng
        Generator of the draw.
    gain_scatter, length_scatter
        Scatter of the gains and lengths between actuators, rms fractions.
    coupling
        Relative surface one pitch away, which sets the length; drawn if absent.
    """
    radius = np.linalg.norm(positions_m, axis=1)
    n, edge = len(positions_m), radius > radius.max() - _EDGE_RING * pitch_m
    length, rounding = rng.uniform(*_LENGTH), rng.uniform(*_ROUNDING)
    if coupling is not None:
        length = exponential_length(coupling, rounding)
    fourfold = rng.uniform(*_FOURFOLD)
    gain = 1 + gain_scatter * rng.standard_normal(n)
    lengths = length * (1 + length_scatter * rng.standard_normal(n))
    return ExponentialInfluenceFunctions(
        positions_m + _POSITION_SCATTER * pitch_m * rng.standard_normal((n, 2)), pitch_m,
        lengths * np.where(edge, 1 + _EDGE_LENGTH, 1.0), np.full(n, rounding),
        gain * np.where(edge, 1 + _EDGE_GAIN, 1.0), np.full(n, fourfold), np.where(edge, _EDGE_SLOPE, 0.0),
    )  # fmt: skip
