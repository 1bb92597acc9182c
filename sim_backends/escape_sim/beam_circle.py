"""The circle that the beam really draws on the pyramid: not quite what the modulator was told."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.modulator import Modulation
from escape_sim.modulation import Modulation as Points
from escape_sim.modulation import n_points

if TYPE_CHECKING:
    from escape_hw.config.models import SystemConfig


class BeamCircle:
    """State of the modulator and what the beam makes of it.

    Parameters
    ----------
    config
        Gives the tilt per lambda/D and the hidden imperfections.
    phase
        Where in its drift the centre starts, radians, along x and y.

    Attributes
    ----------
    modulation
        What the modulator does; ``None`` when it is parked.
    """

    def __init__(self, config: SystemConfig, phase: NDArray[np.float64]) -> None:
        self._config, self._phase = config, phase
        self.modulation: Modulation | None = None

    @property
    def turn_s(self) -> float | None:
        """Duration of a turn in seconds; ``None`` when parked."""
        return None if self.modulation is None else 1 / self.modulation.frequency_hz

    def points(self) -> Points:
        """Points on the pyramid in lambda/D."""
        modulator, told, twin = self._config.devices.modulator, self.modulation, self._config.twin.pyramid
        if told is None or modulator is None:
            return Points.circle(0.0)
        radius = told.radius_rad / modulator.rad_per_lambda_d
        n = n_points(radius)
        angle, lag = 2 * np.pi * np.arange(n) / n, math.radians(twin.phase)
        circle = np.stack([np.cos(angle), np.sin(angle + lag)], axis=1) * radius
        circle *= 1 + np.array([twin.ellipse, -twin.ellipse]) / 2
        return Points(circle + np.divide(told.centre_rad, modulator.rad_per_lambda_d))

    def drift(self, time_s: float) -> NDArray[np.float64]:
        """Where the circle's centre has wandered ``(2,)`` as (x, y) in lambda/D."""
        twin = self._config.twin.pyramid
        return np.asarray(twin.drift * np.sin(2 * np.pi * time_s / twin.drift_time_s + self._phase))
