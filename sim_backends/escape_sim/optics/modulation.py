"""Modulation of a pyramid: points of a modulation path, and the true path of the simulated beam."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.modulator import Modulation

if TYPE_CHECKING:
    from escape_hw.config.system import SystemConfig


def n_points(radius: float) -> int:
    """Points on a modulation circle of ``radius`` lambda/D, about one per lambda/D of path.

    ``4 ceil(2 pi radius / 4)`` as in OOPAO's ``Pyramid``, so that all four faces receive the same number;
    20 points at 3 lambda/D.
    """
    if radius < 0:
        raise ValueError(f"the modulation radius is {radius} lambda/D; it cannot be negative")
    return max(1, 4 * int(np.ceil(2 * np.pi * radius / 4)))


@dataclass(frozen=True, eq=False)
class ModulationPath:
    """Positions of the image on the pyramid, evenly spaced in time over one exposure.

    Parameters
    ----------
    points
        Positions ``(k, 2)`` as (x, y) in lambda/D from the apex.

    Raises
    ------
    ValueError
        The points have another shape or are not finite.
    """

    points: NDArray[np.float64]

    def __post_init__(self) -> None:
        points = np.array(self.points, dtype=float)
        if points.ndim != 2 or points.shape[1] != 2 or not points.size or not np.isfinite(points).all():
            raise ValueError(f"modulation points have shape {points.shape}; they must be finite and (k, 2)")
        object.__setattr__(self, "points", points)

    @property
    def weight(self) -> float:
        """Share of the exposure at each point."""
        return 1 / len(self.points)

    @staticmethod
    def circle(radius: float, *, ellipse: float = 0.0, ellipse_angle: float = 0.0) -> ModulationPath:
        """A circle or ellipse around the apex with :func:`n_points` points; the apex for a radius of 0.

        Parameters
        ----------
        radius
            Radius in lambda/D.
        ellipse, ellipse_angle
            Relative difference of the axes, ``radius (1 +- ellipse / 2)``, and direction of the longer
            axis in radians.
        """
        if radius == 0:
            return ModulationPath(np.zeros((1, 2)))
        k = n_points(radius)
        angle = 2 * np.pi * np.arange(k) / k - ellipse_angle
        along = radius * (1 + ellipse / 2) * np.cos(angle)
        across = radius * (1 - ellipse / 2) * np.sin(angle)
        c, s = np.cos(ellipse_angle), np.sin(ellipse_angle)
        return ModulationPath(np.stack([c * along - s * across, s * along + c * across], axis=1))


#: Reads duration and positions of an emulated stage's cycle; converts such positions to tilts.
_CycleReader = Callable[[], tuple[float, NDArray[np.float64]] | None]
_TiltConverter = Callable[[NDArray[np.float64]], NDArray[np.float64]]


class BeamPath:
    """Path of the simulated beam on the pyramid, commanded by the modulator or by an emulated stage.

    The true imperfections are those of ``twin.pyramid``; ``phase (2,)`` is the phase of the centre's drift
    along x and y in radians. ``modulation`` is the commanded modulation, None when parked.
    """

    def __init__(self, config: SystemConfig, phase: NDArray[np.float64]) -> None:
        self._config, self._phase = config, phase
        self.modulation: Modulation | None = None
        self._emulated: tuple[_CycleReader, _TiltConverter] | None = None

    def follow_stage(self, read_cycle: _CycleReader, to_tilt: _TiltConverter) -> None:
        """Let an emulated stage move the beam from now on; ``modulation`` is ignored.

        ``read_cycle`` returns the duration of a cycle in seconds and positions over it ``(k, 2)``, or None
        at rest; the same object until something changes. ``to_tilt`` converts positions to tilts (x, y) in
        radians.
        """
        self._emulated = (read_cycle, to_tilt)

    @property
    def change_key(self) -> object:
        """Object that is replaced whenever the path changes."""
        return self.modulation if self._emulated is None else self._emulated[0]()

    @property
    def cycle_period_s(self) -> float | None:
        """Duration of a modulation cycle in seconds; None when parked."""
        if self._emulated is not None:
            cycle = self._emulated[0]()
            return None if cycle is None else cycle[0]
        return None if self.modulation is None else 1 / self.modulation.frequency_hz

    def points(self) -> ModulationPath:
        """Modulation path of the beam in lambda/D, without the drift of its centre."""
        path, error = self._path_of_tilts(), self._config.twin.pyramid.radius_error
        return ModulationPath(path.points * (1 + error)) if error else path

    def _path_of_tilts(self) -> ModulationPath:
        """Path in lambda/D if the beam moves by ``devices.modulator.rad_per_lambda_d``."""
        if self._emulated is not None:
            return self._points_of_emulated_stage(*self._emulated)
        modulator, commanded = self._config.devices.modulator, self.modulation
        twin = self._config.twin.pyramid
        if commanded is None or modulator is None:
            return ModulationPath.circle(0.0)
        radius = commanded.radius_rad / modulator.rad_per_lambda_d
        n = n_points(radius)
        angle, lag = 2 * np.pi * np.arange(n) / n, math.radians(twin.phase)
        circle = np.stack([np.cos(angle), np.sin(angle + lag)], axis=1) * radius
        axes = 1 + np.array([twin.ellipse, -twin.ellipse]) / 2
        if twin.ellipse_angle_deg:
            c, s = (
                math.cos(math.radians(twin.ellipse_angle_deg)),
                math.sin(math.radians(twin.ellipse_angle_deg)),
            )
            turn = np.array([[c, -s], [s, c]])
            circle = circle @ (turn * axes @ turn.T)
        else:
            circle *= axes
        return ModulationPath(circle + np.divide(commanded.centre_rad, modulator.rad_per_lambda_d))

    def _points_of_emulated_stage(self, read_cycle: _CycleReader, to_tilt: _TiltConverter) -> ModulationPath:
        """Path of the stage, sampled evenly in time with as many points as a circle of its radius."""
        cycle, modulator = read_cycle(), self._config.devices.modulator
        if cycle is None or modulator is None:
            return ModulationPath.circle(0.0)
        track = to_tilt(cycle[1]) / modulator.rad_per_lambda_d
        n = n_points(float(np.hypot(*(track - track.mean(axis=0)).T).max()))
        at = np.arange(n) / n * len(track)
        closed = np.concatenate([track, track[:1]])
        grid = np.arange(len(closed))
        return ModulationPath(np.stack([np.interp(at, grid, closed[:, axis]) for axis in (0, 1)], axis=1))

    def drift(self, time_s: float) -> NDArray[np.float64]:
        """Drift ``(2,)`` of the modulation centre as (x, y) in lambda/D at a time."""
        twin = self._config.twin.pyramid
        return np.asarray(twin.drift * np.sin(2 * np.pi * time_s / twin.drift_time_s + self._phase))
