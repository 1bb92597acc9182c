"""Results of the optical-gain bootstrap.

The optical gain of a mode is the response of the sensor at its working point relative to its matrix.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.representation import line_html, short_repr, table_html
from escape_hw.api.results import StrehlEstimate
from escape_hw.deprecation import renamed_members


@dataclass(frozen=True, slots=True, eq=False)
class OpticalGains:
    """Gain of every mode relative to a reference matrix; arrays are ``(n_modes,)``.

    Parameters
    ----------
    value, sigma
        Measured gains and standard errors, infinite where a mode was not measured.
    trend, trend_sigma
        Smooth curve over the modes (paper: smoothed overlay).
    best, best_sigma
        Posterior mean of the gains, with which to scale a matrix: the trend plus the departure of each mode
        weighted by its error.
    common_sigma
        Relative standard error common to all modes, from the temporal response, in addition.
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
        Gains relative to the reference matrix, measured in this round.
    poke
        Largest amplitude of the pokes, rms surface as fraction of full stroke.
    frames
        Number of frames.
    change
        Relative change of the gains since the last scaling of the matrix, rms over the modes.
    expected_change
        Expectation of that change from the errors of both.
    residual_nm
        Rms residual wavefront of the controlled modes, scaled by the gains.
    strehl_loss
        Relative loss of Strehl ratio due to the pokes, from their variance in closed loop.
    reached
        Whether the requested accuracy was reached.
    strehl
        Strehl ratios of the science camera, if a model PSF was given.
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
    """One gain tried during the first closure of the loop.

    Parameters
    ----------
    gain
        Gain of the integrator.
    optical_gain, sigma
        Mean optical gain of the matrix there, and its standard error; NaN if not measured.
    residual_nm
        Rms residual wavefront of the controlled modes, scaled by the optical gain.
    stable
        False if the loop diverged.
    """

    gain: float
    optical_gain: float
    sigma: float
    residual_nm: float
    stable: bool


@renamed_members(beside="comparisons")
@dataclass(frozen=True, slots=True, eq=False)
class GainsResult:
    """Result of a bootstrap of the optical gains.

    Parameters
    ----------
    method
        Calibration method of the reference matrix.
    rounds
        The rounds in chronological order.
    closure
        The gains tried during the first closure.
    converged
        Whether the last round, at the last poke, confirmed the gains of the matrix in use.
    loop_gain
        Effective gain of the loop.
    frames, lost_frames
        Of all rounds and the closure.
    comparisons
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
    comparisons: dict[str, OpticalGains] = field(default_factory=dict)
    partial: bool = False
    notes: tuple[str, ...] = ()

    @property
    def gains(self) -> OpticalGains | None:
        """Gains of the last round; ``None`` without rounds."""
        return self.rounds[-1].gains if self.rounds else None

    def __repr__(self) -> str:
        mean = "" if self.gains is None else f" {_format_mean(self.gains)}"
        state = ("converged" if self.converged else "NOT CONVERGED") + (", PARTIAL" if self.partial else "")
        return (
            f"<{type(self).__name__} mean{mean} of {self.method}: {len(self.rounds)} rounds, "
            f"{self.frames} frames, {self.lost_frames} lost, {state}>"
        )

    def _repr_html_(self) -> str:
        """Table of the bootstrap and plot of the gains, for notebooks."""
        gains = self.gains
        rows: dict[str, object] = {"relative to": self.method, "rounds": len(self.rounds)}
        if gains is not None:
            rows["mean"] = _format_mean(gains)
            rows["weakest, strongest"] = f"{gains.best.min():.3f}, {gains.best.max():.3f}"
        rows["converged"] = "yes" if self.converged else "no"
        rows["frames"] = f"{self.frames}, {self.lost_frames} lost"
        return table_html(rows, "Optical gain by mode", "" if gains is None else line_html(gains.best))


def _format_mean(gains: OpticalGains) -> str:
    """Mean over the modes, and mean standard error of a mode."""
    return f"{np.mean(gains.best):.3f} ± {np.mean(gains.best_sigma):.3f}"
