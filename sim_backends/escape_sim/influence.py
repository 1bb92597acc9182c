"""Influence functions of a deformable mirror under any registration."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.registration import Registration


def layout_positions(layout: NDArray[np.bool_], pitch_m: float) -> NDArray[np.float64]:
    """Actuator positions ``(n_act, 2)`` as (x, y) in metres, in row-major order."""
    rows, columns = np.nonzero(layout)
    centre = (np.array(layout.shape[::-1]) - 1) / 2
    return (np.stack([columns, rows], axis=1) - centre) * pitch_m


@dataclass(frozen=True, slots=True, eq=False)
class InfluenceFunctions:
    """Gaussian influence functions, optionally with per-actuator widths and a broad wing.

    The surface per unit command is ``(1 - w) G(s_i) + w G(wing_scale s_i)`` times the actuator's
    gain, where ``G`` is a Gaussian of peak 1 that falls to ``coupling`` at one pitch. As in
    OOPAO (``DeformableMirror.modesComputation``), scalings stretch the widths along x and y, and
    rotation moves the actuators without turning their shapes.

    Parameters
    ----------
    positions_m
        Nominal positions ``(n_act, 2)`` as (x, y) on the pupil in metres.
    pitch_m
        Actuator pitch on the pupil in metres.
    coupling
        Mechanical coupling: relative surface one pitch away.
    width
        Scale of the Gaussian width, one number or ``(n_act,)``.
    gain
        Gain of each actuator, one number or ``(n_act,)``.
    wing
        Share ``w`` of the broad Gaussian.
    wing_scale
        Its width relative to the narrow one.
    """

    positions_m: NDArray[np.float64]
    pitch_m: float
    coupling: float
    width: float | NDArray[np.float64] = 1.0
    gain: float | NDArray[np.float64] = 1.0
    wing: float = 0.0
    wing_scale: float = 2.0

    @property
    def n_act(self) -> int:
        """Number of actuators."""
        return len(self.positions_m)

    def placed(self, registration: Registration, sub_aperture_m: float) -> NDArray[np.float64]:
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
        """Separable factors of the surfaces.

        Parameters
        ----------
        registration, sub_aperture_m
            Registration and the size of a sub-aperture in metres that its shifts refer to.
        x_m, y_m
            Columns' and rows' coordinates ``(n_x,)`` and ``(n_y,)`` in metres.

        Returns
        -------
        along_x : ndarray, ``(n_x, n_act, n_terms)``
        along_y : ndarray, ``(n_y, n_act, n_terms)``
            The surface of actuator ``a`` is ``sum_t along_y[:, a, t] x along_x[:, a, t]``.
        """
        at = self.placed(registration, sub_aperture_m)
        sigma = np.broadcast_to(
            np.asarray(self.width) * self.pitch_m / np.sqrt(2 * np.log(1 / self.coupling)), (self.n_act,)
        )
        stretch = 1 + np.array([registration.radial_scaling, registration.tangential_scaling]) / 100
        terms = [(1.0 - self.wing, 1.0)] + ([(self.wing, self.wing_scale)] if self.wing else [])
        gain = np.broadcast_to(np.asarray(self.gain, dtype=float), (self.n_act,))
        x, y = [], []
        for share, scale in terms:
            x.append(np.exp(-0.5 * ((x_m[:, None] - at[:, 0]) / (sigma * scale * stretch[0])) ** 2))
            y.append(
                share * gain * np.exp(-0.5 * ((y_m[:, None] - at[:, 1]) / (sigma * scale * stretch[1])) ** 2)
            )
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


class MirrorSurface:
    """Fast surface of all actuators together on a fixed grid, in single precision."""

    def __init__(
        self,
        influence: InfluenceFunctions,
        registration: Registration,
        sub_aperture_m: float,
        x_m: NDArray[np.float64],
        y_m: NDArray[np.float64],
    ) -> None:
        along_x, along_y = influence.factors(registration, sub_aperture_m, x_m, y_m)
        self._terms = along_x.shape[2]
        self._x = np.ascontiguousarray(along_x.reshape(x_m.size, -1).T, dtype=np.float32)
        self._y = np.ascontiguousarray(along_y.reshape(y_m.size, -1), dtype=np.float32)

    def __call__(self, command: NDArray[np.float64]) -> NDArray[np.float32]:
        """Surface ``(n_y, n_x)`` in fractions of full stroke for a command ``(n_act,)``."""
        weights = np.repeat(command, self._terms).astype(np.float32)
        return np.asarray((self._y * weights) @ self._x)
