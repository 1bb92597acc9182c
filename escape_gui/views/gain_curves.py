"""Optical gains by mode, on two axes as in the paper."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.optical_gains import OpticalGains


@dataclass(frozen=True, slots=True, eq=False)
class GainCurve:
    """Gains of one matrix.

    Parameters
    ----------
    label
        The matrix that they are relative to.
    value, sigma
        As measured ``(n_modes,)``; modes without a measurement are NaN.
    trend, trend_sigma
        Smooth course ``(n_modes,)``.
    rounds
        Gains by round of the bootstrap ``(n_rounds, n_modes)``.
    """

    label: str
    value: NDArray[np.float64]
    sigma: NDArray[np.float64]
    trend: NDArray[np.float64]
    trend_sigma: NDArray[np.float64]
    rounds: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 0)))

    @classmethod
    def of(cls, label: str, gains: OpticalGains, rounds: Sequence[NDArray[np.float64]] = ()) -> GainCurve:
        """From a result; ``rounds`` are the gains after each round of its bootstrap."""
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
        """Numbers of the modes, from 1."""
        return np.arange(1, self.value.size + 1)

    @property
    def median(self) -> float:
        """Median of the smooth course; NaN when there is nothing yet."""
        known = self.trend[np.isfinite(self.trend)]
        return float(np.median(known)) if known.size else float("nan")


def live_curve(
    label: str,
    gains: NDArray[np.floating],
    sigma: NDArray[np.floating] | None,
    smooth: NDArray[np.floating] | None,
    rounds: NDArray[np.floating] | None,
) -> GainCurve:
    """From the streams ``gains``, ``gains_sigma``, ``gains_smooth`` and ``gains_rounds``.

    They are read one after another, so one of another number of modes is left out.
    """
    value = np.asarray(gains, float).ravel()
    unknown = np.full(value.size, np.nan)

    def matching(data: NDArray[np.floating] | None) -> NDArray[np.float64]:
        good = data is not None and np.size(data) == value.size
        return np.asarray(data, float).ravel() if good else unknown

    errors = matching(sigma)
    errors = np.where(np.isfinite(errors), errors, np.nan)
    round_gains = np.zeros((0, value.size))
    if rounds is not None and np.ndim(rounds) == 2 and rounds.shape[1] == value.size:
        round_gains = np.asarray(rounds, float)
    return GainCurve(label, value, errors, matching(smooth), unknown, round_gains)


def axis_sides(curves: Mapping[str, GainCurve]) -> dict[str, str]:
    """Axis that each curve is read on, ``left`` or ``right``.

    Below 1, measured on a calmer beam than the loop's, left; above 1, measured in open loop, right
    (paper: optical gain vectors). All on the left when they lie on the same side.
    """
    above = {label: curve.median > 1 for label, curve in curves.items()}
    both = any(above.values()) and not all(above.values())
    return {label: "right" if both and high else "left" for label, high in above.items()}
