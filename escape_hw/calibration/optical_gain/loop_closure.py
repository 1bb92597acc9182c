"""First closure of the loop with a matrix of unknown scale."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.optical_gains import ClosureStep
from escape_hw.api.procedure import Procedure
from escape_hw.calibration.optical_gain.estimator import GainMeasurementLoop, LoopSegment, OpticalGainEstimate
from escape_hw.errors import CalibrationError

#: Gain of the integrator at which the loop is effectively open.
_OPEN_LOOP_GAIN = 1e-6
#: First gain relative to the target, for the optical gain of the open loop, which increases up to threefold
#: as the loop removes the turbulence.
_FIRST_GAIN_FRACTION = 0.2
#: Relative tolerance of the effective gain.
_GAIN_TOLERANCE = 0.2
#: Largest factor of a gain step up, and factor of the step down after a failure.
_MAX_STEP_UP, _MAX_STEP_DOWN = 2.0, 0.4
#: Residual, relative to the smallest so far, above which a gain has failed.
_RESIDUAL_INCREASE = 1.3
#: Residual, relative to that in open loop, below which the loop is closed.
_CLOSED_RESIDUAL_RATIO = 0.9
#: Largest number of gains tried.
_MAX_TRIALS = 14
#: Significance of the mean optical gain, in standard errors, that is required.
_MIN_SIGNIFICANCE = 5.0
#: Fraction of the modes that may have a negative gain, by this number of standard errors.
_MAX_WRONG_SIGN_FRACTION, _WRONG_SIGN_SIGMA = 0.15, 3.0


@dataclass(frozen=True, slots=True, eq=False)
class LoopClosure:
    """Gain of the integrator at which the loop is closed, and the measurement there."""

    gain: float
    gains: OpticalGainEstimate
    residual_nm: float


def bootstrap_loop(
    loop: GainMeasurementLoop,
    target_gain: float,
    amplitude: NDArray[np.float64],
    frames: int,
    steps: list[ClosureStep],
) -> Procedure[LoopClosure]:
    """Find a gain at which the loop closes stably, whatever the scale of the matrix.

    The effective gain is the gain of the integrator times the optical gain of the matrix. Pokes measure the
    latter, first with the loop effectively open. The first gain is a fifth of the one that follows from
    that, because the optical gain of a pyramid increases as the loop removes the turbulence; it is measured
    again at every step. If the residual increases, or the mirror stays at its limits, the gain was too high:
    it is reduced, and gains above that one are not tried again.

    Parameters
    ----------
    loop, target_gain
        The started, open loop, and its effective gain.
    amplitude, frames
        Amplitude of the pokes ``(n_modes,)``, and frames at each gain.
    steps
        Each gain tried is appended to it.

    Raises
    ------
    CalibrationError
        The response to the pokes does not agree with the matrix, or the loop closes at no gain.
    """
    loop.control.set_gain(_OPEN_LOOP_GAIN)
    open_segment, mean_gain, _ = yield from _measure_at_gain(
        loop, amplitude, frames, "open loop", _OPEN_LOOP_GAIN, steps
    )
    optical_gain = _require_response(open_segment, mean_gain)
    search = _GainSearch(target_gain, open_segment.residual_nm / optical_gain)
    gain = _FIRST_GAIN_FRACTION * target_gain / optical_gain
    for _ in range(_MAX_TRIALS):
        loop.control.set_gain(gain)
        segment, mean_gain, residual = yield from _measure_at_gain(
            loop, amplitude, frames, f"first closure at gain {gain:.3g}", gain, steps
        )
        if search.update(gain, segment, mean_gain, residual):
            break
        if search.failed:
            # Remove the shape that the unstable loop left on the mirror.
            loop.open_loop()
        gain = search.next_gain(gain)
    return search.best_closure(loop, steps)


def _require_response(segment: LoopSegment, mean_gain: tuple[float, float] | None) -> float:
    """Mean optical gain in open loop; raises :class:`CalibrationError` for a response unlike the matrix."""
    if segment.diverged:
        raise CalibrationError("the pokes alone hold the mirror at its limits; use smaller pokes")
    if mean_gain is None:
        raise CalibrationError(
            "the loop cannot be closed: with this matrix the pokes have no measurable response "
            f"({segment.reason or 'noise'}). Measure the matrix again with more frames, or use larger pokes"
        )
    if mean_gain[0] < 0:
        raise CalibrationError(
            f"the loop cannot be closed: the response to the pokes is {mean_gain[0]:.2g} times that of the "
            "matrix; a sign is wrong (of the matrix, or of the mirror), or the pupil is flipped"
        )
    if segment.gains is not None:
        _require_consistent_signs(segment.gains)
    return mean_gain[0]


def _require_consistent_signs(gains: OpticalGainEstimate) -> None:
    """Raise :class:`CalibrationError` unless most modes have similar gains.

    Optical gains differ by some ten percent between modes. The gains of a matrix of another state of the
    bench are random, of either sign.
    """
    value, sigma = gains.value[0], gains.sigma[0]
    wrong = int(np.count_nonzero(value < -_WRONG_SIGN_SIGMA * sigma))
    scatter = math.sqrt(max(float(np.var(value) - np.mean(sigma**2)), 0.0))
    if wrong > _MAX_WRONG_SIGN_FRACTION * value.size or scatter > float(np.mean(value)):
        raise CalibrationError(
            f"the loop cannot be closed: {wrong} of {value.size} modes have a gain of the opposite sign, and "
            f"the gains scatter by {scatter:.2g} about {np.mean(value):.2g}. The matrix belongs to "
            "another state of the bench (registration, flip or rotation of the pupil); measure it again"
        )


def _measure_at_gain(
    loop: GainMeasurementLoop,
    amplitude: NDArray[np.float64],
    frames: int,
    stage: str,
    gain: float,
    steps: list[ClosureStep],
) -> Procedure[tuple[LoopSegment, tuple[float, float] | None, float]]:
    """Measure at a gain: segment, mean optical gain and error if significant, residual in nm."""
    segment = yield from loop.measure(
        frames, amplitude, stage, max_frames=3 * frames, is_sufficient=_is_significant
    )
    mean_gain = segment.gains.mean() if segment.gains is not None and _is_significant(segment.gains) else None
    residual = segment.residual_nm / abs(mean_gain[0]) if mean_gain is not None else math.inf
    reported = mean_gain if mean_gain is not None else (math.nan, math.nan)
    steps.append(ClosureStep(gain, *reported, residual, not segment.diverged))
    return segment, mean_gain, residual


def _is_significant(gains: OpticalGainEstimate) -> bool:
    value, sigma = gains.mean()
    return abs(value) > _MIN_SIGNIFICANCE * sigma


class _GainSearch:
    """Search for the gain of the integrator with the target effective gain."""

    def __init__(self, target_gain: float, open_nm: float) -> None:
        self._target_gain, self._open_nm = target_gain, open_nm
        self._unstable_gain = math.inf
        self._best_closure: LoopClosure | None = None
        self._next_gain = 0.0
        #: Whether the last gain was too high.
        self.failed = False

    def update(
        self, gain: float, segment: LoopSegment, mean_gain: tuple[float, float] | None, residual: float
    ) -> bool:
        """Add the measurement at a gain; true if the search is finished."""
        smallest = self._open_nm if self._best_closure is None else self._best_closure.residual_nm
        self.failed = segment.diverged or not residual <= _RESIDUAL_INCREASE * smallest
        if self.failed or segment.gains is None or mean_gain is None:
            self._unstable_gain = min(self._unstable_gain, gain)
            self._next_gain = gain * _MAX_STEP_DOWN
            return False
        effective = gain * mean_gain[0]
        if self._best_closure is None or residual < self._best_closure.residual_nm:
            self._best_closure = LoopClosure(gain, segment.gains, residual)
        within_tolerance = abs(effective / self._target_gain - 1) < _GAIN_TOLERANCE
        if within_tolerance:
            self._best_closure = LoopClosure(gain, segment.gains, residual)
        self._next_gain = gain * float(np.clip(self._target_gain / effective, _MAX_STEP_DOWN, _MAX_STEP_UP))
        # Finished if the next gain would exceed one that failed and this one is close to it.
        bracketed = self._next_gain >= self._unstable_gain and gain > 0.7 * self._unstable_gain
        return within_tolerance or bracketed

    def next_gain(self, gain: float) -> float:
        """The gain to try next: the geometric mean with the lowest failed gain if that would be exceeded."""
        if self._next_gain >= self._unstable_gain:
            return float(np.sqrt(gain * self._unstable_gain))
        return self._next_gain

    def best_closure(self, loop: GainMeasurementLoop, steps: list[ClosureStep]) -> LoopClosure:
        """Set the best gain and return its measurement; raises if no gain closed the loop."""
        best = self._best_closure
        if best is None or best.residual_nm > _CLOSED_RESIDUAL_RATIO * self._open_nm:
            tried_gains = ", ".join(f"{step.gain:.3g}" for step in steps[1:])
            observed = (
                "none was stable" if best is None else f"the smallest residual was {best.residual_nm:.0f} nm"
            )
            raise CalibrationError(
                f"the loop does not close: gains {tried_gains} were tried; {observed}, "
                f"{self._open_nm:.0f} nm in open loop. The turbulence may be beyond the sensor's range "
                "(raise sensor.modulation), the matrix too noisy (drop more modes, loop.dropped_modes), or "
                "of another state of the bench"
            )
        loop.control.set_gain(best.gain)
        return best
