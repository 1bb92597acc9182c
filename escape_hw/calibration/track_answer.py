"""What the tracker's look at some frames says: as a row of its table, as numbers and as pictures."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.registration import PARAMETERS, TO_PLAIN
from escape_hw.api.results import CalibrationResult
from escape_hw.api.tracking import TrackResult
from escape_hw.calibration.live_registration import LiveEstimate
from escape_hw.calibration.track_proposal import Proposal

#: What progress reports tell of the last look.
SHOWN = ("shift_x", "shift_x_sigma", "shift_y", "shift_y_sigma", "rotation", "rotation_sigma",
         "optical_gain", "optical_gain_sigma", "misfit")  # fmt: skip
#: Updates that a picture of the registration's course shows.
_COURSE = 4096


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """What the frames up to a moment say, the matrix that follows, and the latest Strehl ratio.

    Parameters
    ----------
    seconds
        The moment, since the loop was closed.
    live
        The live registration.
    made
        The pseudo-synthetic matrix of it.
    proposal
        That matrix, scaled to the live gains, held against the one in use.
    ratio
        Strehl ratio and its error; NaN where there is none.
    """

    seconds: float
    live: LiveEstimate
    made: CalibrationResult
    proposal: Proposal
    ratio: tuple[float, float]


def row_of(
    answer: Answer,
    gains: NDArray[np.float64],
    gains_sigma: NDArray[np.float64],
    residual: NDArray[np.float64],
    exchanged: bool,
) -> dict[str, float]:
    """An answer as a row of the track's table.

    Parameters
    ----------
    answer
        What a look said.
    gains, gains_sigma
        Gain of every mode beside the matrix that tracking began with ``(n_modes,)``, and its error.
    residual
        Residuals of the loop's frames since the last row, in nm ``(n,)``.
    exchanged
        Whether its matrix was taken into use.
    """
    live, found = answer.live, answer.live.registration.measured()
    return {
        "seconds": answer.seconds,
        **{name: one.value for name, one in found.items()},
        **{f"{name}_sigma": one.sigma for name, one in found.items()},
        "optical_gain": float(gains.mean()), "optical_gain_sigma": float(gains_sigma.mean()),
        "misfit": live.misfit, "surprise": live.surprise, "noise": live.noise,
        "mismatch": answer.proposal.evidence.mismatch,
        "residual_nm": float(np.sqrt(np.mean(np.square(residual)))) if residual.size else math.nan,
        "strehl": answer.ratio[0], "strehl_sigma": answer.ratio[1], "exchanged": float(exchanged),
    }  # fmt: skip


def to_show(result: TrackResult) -> dict[str, NDArray[np.float32]]:
    """Course of the registration and present gains, in the units of streams."""
    names = ("seconds", *PARAMETERS, *(f"{name}_sigma" for name in PARAMETERS))
    course = np.array([result.rows[name][-_COURSE:] for name in names]).T
    course[:, 1:] *= np.tile(TO_PLAIN, 2)
    arrays = {
        "registration_track": course,
        "gains": result.optical_gain,
        "gains_sigma": result.optical_gain_sigma,
    }
    return {name: array.astype(np.float32) for name, array in arrays.items()}
