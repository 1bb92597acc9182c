"""Rules that detect a diverging loop, and their limits.

``runner`` checks the mirror's limits in every loop, ``operation`` the residual of a loop that runs until it
is opened, ``tracking.tracker`` that of a tracked one, ``performance`` that of a finished run, and
``optical_gain.bootstrap`` that of a segment. The watchdog of a server
(``escape_hw.server.safety``) checks the published state by the same limits.
"""

from __future__ import annotations

import math
from array import array
from collections import deque
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from escape_hw.config.system import ServerSection
from escape_hw.errors import CalibrationError
from escape_hw.pipeline.statistics import root_mean_square

#: Frames of the running means of the squared residual: the present one and the usual one.
_PRESENT_FRAMES, _USUAL_FRAMES = 50, 2000
#: Blocks whose median residual is the usual one, and the fewest of them.
_MAX_USUAL_BLOCKS, _MIN_USUAL_BLOCKS = 30, 3
#: Ratio of the last third's residual to the middle third's at which a run was not steady, and the fewest
#: residuals of a third.
_MAX_GROWTH_BETWEEN_THIRDS, _MIN_THIRD = 2.0, 20
#: Consecutive saturated frames after which the loop is opened.
_MAX_SATURATED_FRAMES = 50
#: Ratio of the residual to its usual value at which a loop with pokes diverges while the limits shorten more
#: than this fraction of its commands.
_LIMITED_FACTOR, _LIMITED_FRACTION = 2.0, 0.9
#: Ratio of the residual of a segment to the largest of stable segments at which the loop is not stable.
_SEGMENT_FACTOR = 1.5


class SaturationMonitor:
    """Detects a mirror that is held at its limits (``server.saturated_fraction``), frame by frame."""

    def __init__(self, settings: ServerSection, n_act: int) -> None:
        self._max_clipped, self._n_frames = settings.saturated_fraction * n_act, 0

    def __call__(self, n_clipped: int) -> bool:
        """Whether the loop diverges, given the number of actuators beyond the stroke in this frame."""
        self._n_frames = self._n_frames + 1 if n_clipped > self._max_clipped else 0
        return self._n_frames >= _MAX_SATURATED_FRAMES


class ResidualMonitor:
    """Detects a growing residual, frame by frame, before the mirror reaches its limits.

    The residual diverges while its rms over the last 50 frames exceeds ``server.diverging_factor`` times the
    usual rms and also the largest residual of the first 50 frames. A loop that still converges therefore
    stays closed. The usual rms is a running mean over 2000 frames, which diverging frames do not enter.
    """

    def __init__(self, settings: ServerSection, rate_hz: float) -> None:
        self._factor = settings.diverging_factor
        self._max_frames = max(1, round(settings.diverging_s * rate_hz))
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
            limit = max(self._factor**2 * self._usual, self._initial_max)
            if n > 2 * _PRESENT_FRAMES and self._present > limit:
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


class BlockResidualMonitor:
    """Detects a growing residual in blocks of frames of a loop with pokes.

    While pokes are injected, a command beyond the limits is shortened as a whole. A diverging loop then
    holds few actuators at their limits, which :class:`SaturationMonitor` does not detect, and a pyramid's
    slopes saturate before the mirror does.
    """

    def __init__(self, settings: ServerSection) -> None:
        self._factor = settings.diverging_factor
        self._residual: deque[float] = deque(maxlen=_MAX_USUAL_BLOCKS)

    def __call__(self, residual: Sequence[float], n_shortened: int) -> bool:
        """Whether the loop diverged in its last block.

        ``residual``: residual of each frame of the block, in nm; ``n_shortened``: number of commands in the
        block that the limits shortened.
        """
        rms = root_mean_square(residual)
        usual = float(np.median(self._residual)) if len(self._residual) >= _MIN_USUAL_BLOCKS else np.inf
        is_limited = n_shortened > _LIMITED_FRACTION * len(residual)
        factor = _LIMITED_FACTOR if is_limited else self._factor
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


def is_above_stable(residual_nm: float, stable_nm: Sequence[float]) -> bool:
    """Whether the residual of a segment is far above those of stable segments, in nm, if there are any.

    The slopes of a pyramid saturate before the mirror does, so that the limits detect no divergence.
    """
    finite = [value for value in stable_nm if math.isfinite(value)]
    return bool(finite) and residual_nm > _SEGMENT_FACTOR * max(finite)


def require_not_diverged(diverged: bool, frames: int) -> None:
    """Raise :class:`CalibrationError` if the loop was opened because it diverged."""
    if diverged:
        raise CalibrationError(
            f"the loop diverged after {frames} frames and was opened: the actuators stayed at their "
            "limits. Lower loop.gain or raise loop.dropped_modes; if that does not help, measure the matrix "
            "again or check the loop delay"
        )
