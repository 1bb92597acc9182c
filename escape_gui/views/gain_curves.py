"""Optical gains by mode, assigned to two axes as in the paper."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.optical_gains import OpticalGains


@dataclass(frozen=True, slots=True, eq=False)
class GainCurve:
    """Optical gains relative to one matrix."""

    #: Label of the matrix.
    label: str
    #: Measured gains and standard errors ``(n_modes,)``; NaN for modes that were not measured.
    value: NDArray[np.float64]
    sigma: NDArray[np.float64]
    #: Gains smoothed over the modes, and their standard errors ``(n_modes,)``.
    trend: NDArray[np.float64]
    trend_sigma: NDArray[np.float64]
    #: Gains by round of the bootstrap ``(n_rounds, n_modes)``.
    rounds: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 0)))

    @classmethod
    def of(cls, label: str, gains: OpticalGains, rounds: Sequence[NDArray[np.float64]] = ()) -> GainCurve:
        """Build from a result and the gains after each round of its bootstrap."""
        measured = np.isfinite(gains.sigma)
        return cls(
            label,
            np.where(measured, gains.value, np.nan),
            np.where(measured, gains.sigma, np.nan),
            gains.trend,
            gains.trend_sigma,
            np.array(rounds).reshape(-1, gains.n_modes),
        )

    @property
    def modes(self) -> NDArray[np.int_]:
        return np.arange(1, self.value.size + 1)

    @property
    def median(self) -> float:
        """Median of the trend; NaN if there is none yet."""
        known = self.trend[np.isfinite(self.trend)]
        return float(np.median(known)) if known.size else float("nan")


def live_curve(
    label: str,
    gains: NDArray[np.floating],
    sigma: NDArray[np.floating] | None,
    smooth: NDArray[np.floating] | None,
    rounds: NDArray[np.floating] | None,
) -> GainCurve:
    """Build a curve from the streams ``gains``, ``gains_sigma``, ``gains_smooth`` and ``gains_rounds``.

    The streams are read one after another; those with another number of modes than ``gains`` are ignored.
    """
    value = np.asarray(gains, float).ravel()
    unknown = np.full(value.size, np.nan)

    def matching(data: NDArray[np.floating] | None) -> NDArray[np.float64]:
        matches = data is not None and np.size(data) == value.size
        return np.asarray(data, float).ravel() if matches else unknown

    errors = matching(sigma)
    errors = np.where(np.isfinite(errors), errors, np.nan)
    round_gains = np.zeros((0, value.size))
    if rounds is not None and np.ndim(rounds) == 2 and rounds.shape[1] == value.size:
        round_gains = np.asarray(rounds, float)
    return GainCurve(label, value, errors, matching(smooth), unknown, round_gains)


def axis_sides(curves: Mapping[str, GainCurve]) -> dict[str, str]:
    """Axis of each curve by its label, ``left`` or ``right``.

    Gains below 1 (matrix measured with less turbulence than in the loop) are on the left axis, gains above 1
    (matrix measured in open loop) on the right one (paper: optical gain vectors). If all curves are on one
    side of 1, all are on the left axis.
    """
    above = {label: curve.median > 1 for label, curve in curves.items()}
    both = any(above.values()) and not all(above.values())
    return {label: "right" if both and high else "left" for label, high in above.items()}
