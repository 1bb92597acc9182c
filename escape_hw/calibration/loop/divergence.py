"""Rules that detect a diverging loop, and their limits."""

from __future__ import annotations

import math
from array import array
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import NDArray

from escape_hw.config.system import SystemConfig
from escape_hw.errors import CalibrationError

if TYPE_CHECKING:
    from escape_hw.calibration.loop.runner import LoopRecord

#: Frames of the running means of the squared residual: the present one and the usual one.
_PRESENT_FRAMES, _USUAL_FRAMES = 50, 2000
#: Blocks whose median residual is the usual one, and the fewest of them.
_MAX_USUAL_BLOCKS, _MIN_USUAL_BLOCKS = 30, 3
#: Ratio of the last third's residual to the middle third's at which a run was not steady, and the fewest
#: residuals of a third.
_MAX_GROWTH_BETWEEN_THIRDS, _MIN_THIRD = 2.0, 20


@dataclass(frozen=True, slots=True)
class DivergenceLimits:
    """Limits of all divergence rules.

    Parameters
    ----------
    residual_factor
        Ratio of the residual's rms to its usual value above which the residual diverges.
    residual_s
        Seconds of a diverging residual after which the loop is opened.
    saturated_fraction
        Share of the actuators beyond their limits above which a frame counts as saturated.
    saturated_frames
        Consecutive saturated frames after which the loop is opened.
    limited_residual_factor
        As ``residual_factor``, for a loop with pokes while the limits shorten its commands.
    limited_fraction
        Share of shortened commands at which ``limited_residual_factor`` applies.
    """

    residual_factor: float = 4.0
    residual_s: float = 1.0
    saturated_fraction: float = 0.2
    saturated_frames: int = 50
    limited_residual_factor: float = 2.0
    limited_fraction: float = 0.9

    @classmethod
    def from_config(cls, config: SystemConfig) -> Self:
        """Limits of ``[server]``: ``diverging_factor``, ``diverging_s``, ``saturated_fraction``."""
        server = config.server
        return cls(server.diverging_factor, server.diverging_s, server.saturated_fraction)


class SaturationMonitor:
    """Detects a mirror that is held at its limits, frame by frame."""

    def __init__(self, limits: DivergenceLimits, n_act: int) -> None:
        self._max_clipped, self._max_frames = limits.saturated_fraction * n_act, limits.saturated_frames
        self._n_frames = 0

    def __call__(self, n_clipped: int) -> bool:
        """Whether the loop diverges, given the number of actuators beyond the stroke in this frame."""
        self._n_frames = self._n_frames + 1 if n_clipped > self._max_clipped else 0
        return self._n_frames >= self._max_frames


class ResidualMonitor:
    """Detects a growing residual, frame by frame, before the mirror reaches its limits.

    The residual diverges while its rms over the last 50 frames exceeds ``residual_factor`` times the usual
    rms and also the largest residual of the first 50 frames. A loop that still converges therefore stays
    closed. The usual rms is a running mean over 2000 frames, which diverging frames do not enter.

    Parameters
    ----------
    limits
        Factor and time.
    rate_hz
        Frames per second.
    """

    def __init__(self, limits: DivergenceLimits, rate_hz: float) -> None:
        self._factor, self._max_frames = limits.residual_factor, max(1, round(limits.residual_s * rate_hz))
        self._present = self._usual = self._initial_max = math.nan
        self._n_residuals = self._n_diverging = 0

    def __call__(self, residual: array[float]) -> bool:
        """Add the residuals since the last call, in nm; whether the loop diverges."""
        for value in residual:
            square = value * value
            if not self._n_residuals:
                self._present = self._usual = self._initial_max = square
            self._n_residuals += 1
            n = self._n_residuals
            if n <= _PRESENT_FRAMES:
                self._initial_max = max(self._initial_max, square)
            self._present += (square - self._present) / min(n, _PRESENT_FRAMES)
            if n > 2 * _PRESENT_FRAMES and self._present > self._limit():
                self._n_diverging += 1
            else:
                self._n_diverging = 0
                self._usual += (square - self._usual) / min(n, _USUAL_FRAMES)
        not_finite = self._n_residuals > 0 and not math.isfinite(self._present)
        return not_finite or self._n_diverging >= self._max_frames

    @property
    def growth(self) -> float:
        """Present rms divided by the usual rms."""
        return math.sqrt(self._present / self._usual) if self._usual > 0 else math.nan

    def _limit(self) -> float:
        return max(self._factor**2 * self._usual, self._initial_max)


class BlockResidualMonitor:
    """Detects a growing residual in blocks of frames of a loop with pokes.

    While pokes are injected, a command beyond the limits is shortened as a whole. A diverging loop then
    holds few actuators at their limits, which :class:`SaturationMonitor` does not detect, and a pyramid's
    slopes saturate before the mirror does.
    """

    def __init__(self, limits: DivergenceLimits) -> None:
        self._limits = limits
        self._residual: deque[float] = deque(maxlen=_MAX_USUAL_BLOCKS)

    def __call__(self, record: LoopRecord, frames: int, shortened: int) -> bool:
        """Whether the loop diverged in its last block.

        Parameters
        ----------
        record
            Record of the loop.
        frames, shortened
            Frames and shortened commands in the record before the block.
        """
        residual = np.array(record.residual[frames:])
        rms = float(np.sqrt(np.mean(np.square(residual))))
        usual = float(np.median(self._residual)) if len(self._residual) >= _MIN_USUAL_BLOCKS else np.inf
        is_limited = record.shortened - shortened > self._limits.limited_fraction * len(residual)
        factor = self._limits.limited_residual_factor if is_limited else self._limits.residual_factor
        if rms > factor * usual:
            return True
        self._residual.append(rms)
        return False


def is_steady(residual: NDArray[np.float32]) -> bool:
    """Whether the residuals ``(n,)`` are finite and do not double from the middle third to the last."""
    third = residual.size // 3
    if third < _MIN_THIRD:
        return bool(np.isfinite(residual).all())
    middle, last = np.median(residual[third : 2 * third]), np.median(residual[2 * third :])
    return bool(np.isfinite(residual).all() and last < _MAX_GROWTH_BETWEEN_THIRDS * middle)


def require_not_diverged(record: LoopRecord) -> None:
    """Raise :class:`CalibrationError` if the loop was opened because it diverged."""
    if record.diverged:
        raise CalibrationError(
            f"the loop diverged after {record.frames} frames and was opened: the actuators stayed at their "
            "limits. Lower loop.gain or raise loop.dropped_modes; if that does not help, measure the matrix "
            "again or check the loop delay"
        )
