"""Points on which the modulator sets the image while a pyramid exposes."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray


def n_points(radius: float) -> int:
    """Points on a modulation circle of ``radius`` lambda/D: about one per lambda/D of path.

    ``4 ceil(2 pi radius / 4)``, as in OOPAO's ``Pyramid``: a multiple of four, so that all four faces
    see the same; 20 points at 3 lambda/D.
    """
    if radius < 0:
        raise ValueError(f"the modulation radius is {radius} lambda/D; it cannot be negative")
    return max(1, 4 * int(np.ceil(2 * np.pi * radius / 4)))


@dataclass(frozen=True, eq=False)
class Modulation:
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
    ) -> Modulation:
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
            return Modulation(np.array([centre], dtype=float))
        angle = 2 * np.pi * np.arange(k) / k + phase - ellipse_angle
        along = radius * (1 + ellipse / 2) * np.cos(angle)
        across = radius * (1 - ellipse / 2) * np.sin(angle)
        c, s = np.cos(ellipse_angle), np.sin(ellipse_angle)
        return Modulation(np.stack([c * along - s * across, s * along + c * across], axis=1) + centre)
