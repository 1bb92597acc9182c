"""Modulation of a pyramid: points of a modulation path, and the true path of the simulated beam (ellipse, lag, drift, or an emulated stage)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.modulator import Modulation

if TYPE_CHECKING:
    from escape_hw.config.system import SystemConfig


def n_points(radius: float) -> int:
    """Points on a modulation circle of ``radius`` lambda/D: about one per lambda/D of path.

    ``4 ceil(2 pi radius / 4)``, as in OOPAO's ``Pyramid``: a multiple of four, so that all four faces
    see the same; 20 points at 3 lambda/D.
    """
    if radius < 0:
        raise ValueError(f"the modulation radius is {radius} lambda/D; it cannot be negative")
    return max(1, 4 * int(np.ceil(2 * np.pi * radius / 4)))


@dataclass(frozen=True, eq=False)
class ModulationPath:
    """Positions of the image on the pyramid during one exposure.

    Parameters
    ----------
    points
        Positions ``(k, 2)`` as (x, y) in lambda/D from the apex.
    weights
        Share of the exposure spent on each ``(k,)``; scaled to sum to 1. Equal by default.
    """

    points: NDArray[np.float64]
    weights: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))

    def __post_init__(self) -> None:
        points = np.array(self.points, dtype=float)
        if points.ndim != 2 or points.shape[1] != 2 or not points.size or not np.isfinite(points).all():
            raise ValueError(f"modulation points must be finite and (k, 2); these are {points.shape}")
        weights = np.array(self.weights, dtype=float) if np.size(self.weights) else np.ones(len(points))
        if weights.shape != (len(points),) or not (weights >= 0).all() or not weights.sum() > 0:
            raise ValueError(
                f"{len(points)} modulation points need as many weights, none negative and not all zero"
            )
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "weights", weights / weights.sum())

    @property
    def n_points(self) -> int:
        """Number of points."""
        return len(self.points)

    @staticmethod
    def circle(
        radius: float,
        points: int | None = None,
        *,
        ellipse: float = 0.0,
        ellipse_angle: float = 0.0,
        phase: float = 0.0,
        centre: tuple[float, float] = (0.0, 0.0),
    ) -> ModulationPath:
        """Points spread evenly in time over a circle, the first on the +x axis.

        Parameters
        ----------
        radius
            Radius in lambda/D; at 0 the image rests at ``centre``.
        points
            Number of points; :func:`n_points` of the radius by default.
        ellipse
            Relative difference of the two axes: the axes are ``radius (1 +- ellipse / 2)``.
        ellipse_angle
            Direction of the longer axis in radians.
        phase
            Angle of the first point in radians.
        centre
            Centre (x, y) of the circle in lambda/D.
        """
        k = n_points(radius) if points is None else points
        if radius == 0:
            return ModulationPath(np.array([centre], dtype=float))
        angle = 2 * np.pi * np.arange(k) / k + phase - ellipse_angle
        along = radius * (1 + ellipse / 2) * np.cos(angle)
        across = radius * (1 - ellipse / 2) * np.sin(angle)
        c, s = np.cos(ellipse_angle), np.sin(ellipse_angle)
        return ModulationPath(np.stack([c * along - s * across, s * along + c * across], axis=1) + centre)


#: An emulated stage: duration and places of its turn, and what tilt a place is.
_CycleReader = Callable[[], tuple[float, NDArray[np.float64]] | None]
_TiltConverter = Callable[[NDArray[np.float64]], NDArray[np.float64]]


class BeamPath:
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
        self._emulated: tuple[_CycleReader, _TiltConverter] | None = None

    def follow_stage(self, read_cycle: _CycleReader, to_tilt: _TiltConverter) -> None:
        """From now on the beam goes where an emulated stage points, and ``modulation`` counts no more.

        Parameters
        ----------
        turn
            Duration of a turn in seconds and places over it ``(k, 2)``, ``None`` at rest; the same object
            as long as nothing changes.
        tilt
            Makes tilts (x, y) in radians from its places.
        """
        self._emulated = (read_cycle, to_tilt)

    @property
    def change_key(self) -> object:
        """Another object whenever the circle has changed."""
        return self.modulation if self._emulated is None else self._emulated[0]()

    @property
    def cycle_period_s(self) -> float | None:
        """Duration of a turn in seconds; ``None`` when parked."""
        if self._emulated is not None:
            cycle = self._emulated[0]()
            return None if cycle is None else cycle[0]
        return None if self.modulation is None else 1 / self.modulation.frequency_hz

    def points(self) -> ModulationPath:
        """Points on the pyramid in lambda/D."""
        if self._emulated is not None:
            return self._points_of_emulated_stage(*self._emulated)
        modulator, commanded, twin = (
            self._config.devices.modulator,
            self.modulation,
            self._config.twin.pyramid,
        )
        if commanded is None or modulator is None:
            return ModulationPath.circle(0.0)
        radius = commanded.radius_rad / modulator.rad_per_lambda_d
        n = n_points(radius)
        angle, lag = 2 * np.pi * np.arange(n) / n, math.radians(twin.phase)
        circle = np.stack([np.cos(angle), np.sin(angle + lag)], axis=1) * radius
        circle *= 1 + np.array([twin.ellipse, -twin.ellipse]) / 2
        return ModulationPath(circle + np.divide(commanded.centre_rad, modulator.rad_per_lambda_d))

    def _points_of_emulated_stage(self, read_cycle: _CycleReader, to_tilt: _TiltConverter) -> ModulationPath:
        """As many points as a circle of that size gets, evenly spread over the turn."""
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
        """Where the circle's centre has wandered ``(2,)`` as (x, y) in lambda/D."""
        twin = self._config.twin.pyramid
        return np.asarray(twin.drift * np.sin(2 * np.pi * time_s / twin.drift_time_s + self._phase))
