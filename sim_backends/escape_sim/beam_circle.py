"""The circle that the beam really draws on the pyramid: not quite what the modulator was told."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.modulator import Modulation
from escape_sim.modulation import Modulation as Points
from escape_sim.modulation import n_points

if TYPE_CHECKING:
    from escape_hw.config.models import SystemConfig

#: An emulated stage: duration and places of its turn, and what tilt a place is.
_Turn = Callable[[], tuple[float, NDArray[np.float64]] | None]
_Tilt = Callable[[NDArray[np.float64]], NDArray[np.float64]]


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
        self._emulated: tuple[_Turn, _Tilt] | None = None

    def follow(self, turn: _Turn, tilt: _Tilt) -> None:
        """From now on the beam goes where an emulated stage points, and ``modulation`` counts no more.

        Parameters
        ----------
        turn
            Duration of a turn in seconds and places over it ``(k, 2)``, ``None`` at rest; the same object
            as long as nothing changes.
        tilt
            Makes tilts (x, y) in radians from its places.
        """
        self._emulated = (turn, tilt)

    @property
    def state(self) -> object:
        """Another object whenever the circle has changed."""
        return self.modulation if self._emulated is None else self._emulated[0]()

    @property
    def turn_s(self) -> float | None:
        """Duration of a turn in seconds; ``None`` when parked."""
        if self._emulated is not None:
            turned = self._emulated[0]()
            return None if turned is None else turned[0]
        return None if self.modulation is None else 1 / self.modulation.frequency_hz

    def points(self) -> Points:
        """Points on the pyramid in lambda/D."""
        if self._emulated is not None:
            return self._emulated_points(*self._emulated)
        modulator, told, twin = self._config.devices.modulator, self.modulation, self._config.twin.pyramid
        if told is None or modulator is None:
            return Points.circle(0.0)
        radius = told.radius_rad / modulator.rad_per_lambda_d
        n = n_points(radius)
        angle, lag = 2 * np.pi * np.arange(n) / n, math.radians(twin.phase)
        circle = np.stack([np.cos(angle), np.sin(angle + lag)], axis=1) * radius
        circle *= 1 + np.array([twin.ellipse, -twin.ellipse]) / 2
        return Points(circle + np.divide(told.centre_rad, modulator.rad_per_lambda_d))

    def _emulated_points(self, turn: _Turn, tilt: _Tilt) -> Points:
        """As many points as a circle of that size gets, evenly spread over the turn."""
        turned, modulator = turn(), self._config.devices.modulator
        if turned is None or modulator is None:
            return Points.circle(0.0)
        track = tilt(turned[1]) / modulator.rad_per_lambda_d
        n = n_points(float(np.hypot(*(track - track.mean(axis=0)).T).max()))
        at = np.arange(n) / n * len(track)
        closed = np.concatenate([track, track[:1]])
        grid = np.arange(len(closed))
        return Points(np.stack([np.interp(at, grid, closed[:, axis]) for axis in (0, 1)], axis=1))

    def drift(self, time_s: float) -> NDArray[np.float64]:
        """Where the circle's centre has wandered ``(2,)`` as (x, y) in lambda/D."""
        twin = self._config.twin.pyramid
        return np.asarray(twin.drift * np.sin(2 * np.pi * time_s / twin.drift_time_s + self._phase))
