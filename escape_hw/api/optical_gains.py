"""Optical gains: how much weaker a sensor answers on the wavefront it works on than its matrix says."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.representation import line_html, short_repr, table_html
from escape_hw.api.results import StrehlEstimate


@dataclass(frozen=True, slots=True, eq=False)
class OpticalGains:
    """Gain of every mode relative to a reference matrix; each field ``(n_modes,)`` unless it says else.

    Parameters
    ----------
    value, sigma
        As measured, mode by mode, with standard errors (infinite where a mode was not measured).
    trend, trend_sigma
        Smooth course over the order of the modes (paper: smoothed overlay).
    best, best_sigma
        What to scale a matrix by: the trend, and as much of each mode's own departure from it as its
        error lets one believe.
    common_sigma
        Relative standard error that all modes share beside their own, from the temporal response.
    """

    value: NDArray[np.float64]
    sigma: NDArray[np.float64]
    trend: NDArray[np.float64]
    trend_sigma: NDArray[np.float64]
    best: NDArray[np.float64]
    best_sigma: NDArray[np.float64]
    common_sigma: float = 0.0
    __repr__ = short_repr

    @property
    def n_modes(self) -> int:
        """Number of modes."""
        return int(self.value.size)


@dataclass(frozen=True, slots=True, eq=False)
class GainRound:
    """One round of the bootstrap.

    Parameters
    ----------
    gains
        Relative to the reference matrix, as measured in this round.
    poke
        Amplitude of each mode's pokes at most, rms surface as fraction of full stroke.
    frames
        Frames that it took.
    change
        Rms over the modes of the relative change of the gains since the loop was last scaled.
    expected_change
        What the errors of both let one expect of it.
    residual_nm
        Rms wavefront that the sensor sees of the controlled modes, scaled by the gains.
    strehl_loss
        Share of the Strehl ratio that the pokes cost, from their variance through the loop.
    reached
        Whether the asked accuracy was reached.
    strehl
        Of the science camera, when a model PSF was given.
    """

    gains: OpticalGains
    poke: float
    frames: int
    change: float
    expected_change: float
    residual_nm: float
    strehl_loss: float
    reached: bool
    strehl: StrehlEstimate | None = None
    __repr__ = short_repr


@dataclass(frozen=True, slots=True)
class ClosureStep:
    """One gain tried while closing the loop for the first time.

    Parameters
    ----------
    gain
        Gain of the integrator.
    optical_gain, sigma
        Mean optical gain of the matrix there, and its standard error; NaN where the loop had to be
        opened.
    residual_nm
        Rms wavefront of the controlled modes, scaled by the optical gain.
    stable
        False when the loop was opened because it diverged.
    """

    gain: float
    optical_gain: float
    sigma: float
    residual_nm: float
    stable: bool


@dataclass(frozen=True, slots=True, eq=False)
class GainsResult:
    """A bootstrap of the optical gains.

    Parameters
    ----------
    method
        Of the matrix that the gains are relative to.
    rounds
        One for each amplitude, in their order.
    closure
        The gains tried before.
    converged
        Whether the last round found the gains that the loop was scaled with, at the last poke.
    loop_gain
        Gain that the loop ran with, its matrix scaled.
    frames, lost_frames
        Of all rounds and the closure.
    beside
        Gains of other matrices by name, from the last round.
    partial
        Stopped by the operator.
    """

    method: str
    rounds: tuple[GainRound, ...]
    closure: tuple[ClosureStep, ...]
    converged: bool
    loop_gain: float
    frames: int
    lost_frames: int
    beside: dict[str, OpticalGains] = field(default_factory=dict)
    partial: bool = False
    notes: tuple[str, ...] = ()

    @property
    def gains(self) -> OpticalGains | None:
        """Of the last round, if there was one."""
        return self.rounds[-1].gains if self.rounds else None

    def __repr__(self) -> str:
        mean = "" if self.gains is None else f" {_format_mean(self.gains)}"
        state = ("converged" if self.converged else "NOT CONVERGED") + (", PARTIAL" if self.partial else "")
        return (
            f"<{type(self).__name__} mean{mean} of {self.method}: {len(self.rounds)} rounds, "
            f"{self.frames} frames, {self.lost_frames} lost, {state}>"
        )

    def _repr_html_(self) -> str:
        """For notebooks: gain by mode, and how the bootstrap went."""
        gains = self.gains
        rows: dict[str, object] = {"relative to": self.method, "rounds": len(self.rounds)}
        if gains is not None:
            rows["mean"] = _format_mean(gains)
            rows["weakest, strongest"] = f"{gains.best.min():.3f}, {gains.best.max():.3f}"
        rows["converged"] = "yes" if self.converged else "no"
        rows["frames"] = f"{self.frames}, {self.lost_frames} lost"
        return table_html(rows, "Optical gain by mode", "" if gains is None else line_html(gains.best))


def _format_mean(gains: OpticalGains) -> str:
    """Mean over the modes, and the mean error of one."""
    return f"{np.mean(gains.best):.3f} ± {np.mean(gains.best_sigma):.3f}"
