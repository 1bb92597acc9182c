"""Whether the sensor answers later than the temporal response has lags for."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from escape_hw.calibration.response import SLOPES, Half, filtered, halves, shifted
from escape_hw.calibration.telemetry import Telemetry
from escape_hw.errors import CalibrationError

#: Frames beyond the lags in which an answer is looked for.
_BEYOND = 8
#: Standard errors by which it must stand out, and its least share of the response that was found.
_CLEARLY, _SHARE = 6.0, 0.25


def require_whole_response(data: Telemetry, whitener: NDArray[np.float64], lags: int) -> None:
    """Refuse to go on with too few lags, which would give a matrix that is wrong and looks sound.

    Whitened pokes are correlated from frame to frame, so a response later than all lags still shows in
    them, with the wrong size or even sign. What such a response leaves in the slopes goes with the pokes
    of the later lags, and noise does not.

    Parameters
    ----------
    data
        Frames and pokes.
    whitener
        Filter over time.
    lags
        Number of lags of the temporal response.

    Raises
    ------
    CalibrationError
        There is an answer after the last lag; says when.
    """
    parts = halves(filtered(data.thinned(SLOPES), whitener, lags + _BEYOND), lags)
    late = np.array([_late(part, lags) for part in parts])
    share, clearly = late[:, 0], late[:, 1]
    # The same lag in both halves, each with the matrix of the other.
    found = (np.abs(share).min(axis=0) > _SHARE) & (clearly.min(axis=0) > _CLEARLY)
    if found.any():
        lag = lags + int(np.argmax(np.where(found, np.abs(share).min(axis=0), 0.0)))
        raise CalibrationError(
            f"the sensor answers pokes {lag} frames after they were sent, later than calibration.lags = "
            f"{lags} frames can tell; set calibration.lags to at least {lag + 3}"
        )


def _late(part: Half, lags: int) -> NDArray[np.float64]:
    """For each later lag, its share of the response found, and by how many standard errors ``(2, n)``."""
    left, weights = part.slopes.astype(float), part.sums.weights()
    for lag, weight in enumerate(weights):
        left -= weight * shifted(part.predicted, part.now, lag)
    size = float(np.vdot(*(shifted(rows, part.now, 0) for rows in (part.instrument, part.predicted))))
    size *= np.abs(weights).max()
    rows = []
    for lag in range(lags, lags + _BEYOND):
        # Neighbouring slopes err together, frames (whitened) do not.
        scores = np.einsum("ts,ts->t", shifted(part.instrument, part.now, lag), left)
        rows.append([scores.sum() / size, abs(scores.sum()) / np.sqrt(np.square(scores).sum())])
    return np.array(rows).T
