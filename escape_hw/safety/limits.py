"""Limits of mirror commands (applied in ``guard``), and pairs of adjacent actuators."""

from __future__ import annotations

import operator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

#: Largest distance of adjacent actuators, in units of the median distance to the nearest one.
_MAX_PAIR_DISTANCE = 1.3


@dataclass(frozen=True, slots=True)
class MirrorLimits:
    """Limits in fractions of full stroke; ``None`` switches a rule off.

    Parameters
    ----------
    max_stroke
        Largest magnitude of any actuator's command, 0 to 1.
    max_slew
        Largest change of any actuator from one command to the next.
    max_neighbour
        Largest difference between adjacent actuators.
    max_mean
        Largest magnitude of the mean over the enabled actuators (piston drift).
    disabled
        Indices of actuators that must stay at zero, counted from 0.
    max_abs_sum
        Largest sum of the magnitudes of all commands, in full strokes (current or heat of the electronics).

    Raises
    ------
    ValueError
        A limit is not a positive number, or ``disabled`` contains something other than indices.
    """

    max_stroke: float = 1.0
    max_slew: float | None = None
    max_neighbour: float | None = None
    max_mean: float | None = None
    disabled: tuple[int, ...] = ()
    max_abs_sum: float | None = None

    def __post_init__(self) -> None:
        if not 0.0 < self.max_stroke <= 1.0:
            raise ValueError(f"max_stroke is {self.max_stroke}; it must lie in (0, 1]")
        for name in ("max_slew", "max_neighbour", "max_mean", "max_abs_sum"):
            value = getattr(self, name)
            if value is not None and not value > 0.0:
                raise ValueError(f"{name} is {value}; it must be positive, or None to switch it off")
        try:
            disabled = tuple(operator.index(i) for i in self.disabled)
        except TypeError as error:
            raise ValueError(f"disabled is {self.disabled!r}; it must hold whole numbers") from error
        if any(i < 0 for i in disabled):
            raise ValueError(f"disabled is {disabled}; actuators are counted from 0")
        object.__setattr__(self, "disabled", disabled)


#: Limits of a mirror that is opened without a system file and without limits.
CAUTIOUS_LIMITS = MirrorLimits(
    max_stroke=0.5, max_slew=0.2, max_neighbour=0.4, max_mean=0.1, max_abs_sum=20.0
)


def neighbour_pairs(layout: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Pairs of adjacent actuators on a grid.

    Parameters
    ----------
    layout
        Boolean map ``(rows, cols)``, true where there is an actuator; numbered in row-major order.

    Returns
    -------
    ndarray of int, ``(n_pairs, 2)``
        Every horizontal and vertical pair once.

    Raises
    ------
    ValueError
        The layout is not two-dimensional.
    """
    if layout.ndim != 2:
        raise ValueError(f"layout has shape {layout.shape}; it must be a map (rows, columns)")
    layout = np.asarray(layout, dtype=bool)
    number = np.full(layout.shape, -1, dtype=np.intp)
    number[layout] = np.arange(int(layout.sum()))
    pairs = [
        np.stack([a[both], b[both]], axis=1)
        for a, b in ((number[:, :-1], number[:, 1:]), (number[:-1], number[1:]))
        for both in [(a >= 0) & (b >= 0)]
    ]
    return np.concatenate(pairs)


def all_pairs(n_act: int) -> NDArray[np.intp]:
    """Every pair of actuators once ``(n_pairs, 2)``: the neighbours where the arrangement is not known."""
    return np.stack(np.triu_indices(n_act, 1), axis=1)


def nearest_pairs(positions: NDArray[np.float64]) -> NDArray[np.intp]:
    """Pairs of adjacent actuators, up to 1.3 median distances to the nearest actuator apart.

    On a square grid these are the pairs of :func:`neighbour_pairs`, because a diagonal is 1.41 pitches long.

    Parameters
    ----------
    positions
        Actuator positions ``(n_act, 2)``.

    Returns
    -------
    ndarray of int, ``(n_pairs, 2)``
        Every pair once, lower number first.

    Raises
    ------
    ValueError
        The positions are not finite ``(n_act, 2)``, or two actuators have the same position.
    """
    at = np.asarray(positions, dtype=float)
    if at.ndim != 2 or at.shape[1] != 2 or not np.isfinite(at).all():
        raise ValueError(f"positions have shape {at.shape}; they must be finite, (n_act, 2)")
    if len(at) < 2:
        return np.empty((0, 2), dtype=np.intp)
    distance = np.hypot(*(at[:, None, k] - at[:, k] for k in (0, 1)))
    np.fill_diagonal(distance, np.inf)
    nearest = distance.min(axis=1)
    if not nearest.min() > 0:
        one = int(nearest.argmin())
        raise ValueError(f"actuators {one} and {int(distance[one].argmin())} have the same position")
    return np.argwhere(np.triu(distance <= _MAX_PAIR_DISTANCE * np.median(nearest))).astype(np.intp)
