"""Flexure: a registration that moves slowly, and the mirror's surface that moves with it."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.registration import PARAMETERS, Registration
from escape_sim.mirror_surface import InfluenceShapes, Surface, mirror_surface

if TYPE_CHECKING:
    from escape_hw.config.twin_drift import TwinDrift

#: Largest way of each parameter between two derivations of the surface, in its units. A hundredth of
#: a percent of a sub-aperture is a fifth of what the best registration errs by.
_WAY = np.array([0.01, 0.01, 3e-4, 0.003, 0.003])


class Flexure:
    """Where the mirror sits at a moment: hidden truth.

    Parameters
    ----------
    start
        Registration at time zero.
    drift
        Rates, sinusoid and period.

    Attributes
    ----------
    step_s
        Seconds in which no parameter moves by more than the surface is derived anew for.
    """

    def __init__(self, start: Registration, drift: TwinDrift) -> None:
        self._start, self._drift = start, drift
        rate, swing = (
            np.array([getattr(part, name) for name in PARAMETERS]) for part in (drift.rate, drift.swing)
        )
        fastest = float(((np.abs(rate) + np.abs(swing) * 2 * math.pi / drift.period_s) / _WAY).max())
        self.step_s = 1 / fastest if fastest else math.inf

    def at(self, time_s: float) -> Registration:
        """The registration at a time of the twin's clock, in seconds."""
        there = Registration.from_array(self._start.to_array() + self._drift.way(time_s))
        return replace(there, anamorphosis_angle=self._start.anamorphosis_angle)


class FlexingSurface:
    """Commands to surfaces under a registration that moves; derived anew as seldom as it may be.

    The surface of a moment depends on that moment alone, whatever was asked before.

    Parameters
    ----------
    influence, sub_aperture_m, x_m, y_m
        As for :func:`~escape_sim.mirror_surface.mirror_surface`.
    flexure
        Where the mirror sits.
    """

    def __init__(
        self,
        influence: InfluenceShapes,
        flexure: Flexure,
        sub_aperture_m: float,
        x_m: NDArray[np.float64],
        y_m: NDArray[np.float64],
    ) -> None:
        self._influence, self._flexure, self._sub = influence, flexure, sub_aperture_m
        self._x, self._y = x_m, y_m
        self._number = 0
        self._surface = self._derived(0)

    def __call__(self, command: NDArray[np.float64], time_s: float) -> NDArray[np.float32]:
        """Surface ``(n_y, n_x)`` in fractions of full stroke for a command ``(n_act,)`` at a time."""
        number = math.floor(time_s / self._flexure.step_s)
        if number != self._number:
            self._surface, self._number = self._derived(number), number
        return self._surface(command)

    def _derived(self, number: int) -> Surface:
        """The surface in the middle of step ``number``."""
        step = self._flexure.step_s
        where = self._flexure.at(0.0 if math.isinf(step) else (number + 0.5) * step)
        return mirror_surface(self._influence, where, self._sub, self._x, self._y)
