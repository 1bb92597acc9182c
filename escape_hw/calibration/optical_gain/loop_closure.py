"""Closing the loop for the first time, with a matrix whose scale nobody knows."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.optical_gains import ClosureStep
from escape_hw.api.procedure import Procedure
from escape_hw.calibration.optical_gain.estimator import GainMeasurementLoop, LoopSegment, OpticalGainEstimate
from escape_hw.errors import CalibrationError

#: Gain of the integrator at which the loop is as good as open.
_OPEN_LOOP_GAIN = 1e-6
#: Share of the wanted gain at which it closes first, counted by the optical gain of the open loop: that
#: rises as the turbulence goes, up to threefold.
_FIRST_GAIN_FRACTION = 0.2
#: The gain is found when it is within this share of the wanted one.
_GAIN_TOLERANCE = 0.2
#: Largest step of the gain up, and the step down when the loop got worse.
_MAX_STEP_UP, _MAX_STEP_DOWN = 2.0, 0.4
#: Residual relative to the best so far that counts as worse.
_RESIDUAL_INCREASE = 1.3
#: Residual relative to the open loop's below which the loop counts as closed.
_CLOSED_RESIDUAL_RATIO = 0.9
#: Gains tried at most.
_MAX_TRIALS = 14
#: Standard errors by which the optical gain must differ from none.
_MIN_SIGNIFICANCE = 5.0
#: Share of the modes that may answer with the opposite sign, by so many standard errors.
_MAX_WRONG_SIGN_FRACTION, _WRONG_SIGN_SIGMA = 0.15, 3.0


@dataclass(frozen=True, slots=True, eq=False)
class LoopClosure:
    """A loop that was closed: with which gain of the integrator, and what was measured there."""

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
    """Find a gain at which the loop closes stably, whatever the matrix is scaled by.

    The effective gain of a loop is the integrator's times the matrix's optical gain. Pokes measure
    the latter, first with the loop as good as open, and tell how far the integrator's gain is from what
    makes the effective one as wanted. It starts at a fifth of that, since a pyramid answers better the
    less is left of the turbulence, and is measured again at every step. When the residual rises, or the
    mirror stays at its limits, the gain was too high: it is lowered, and that gain never tried again.

    Parameters
    ----------
    loop
        Started, not closed yet.
    wanted
        Effective gain.
    amplitude
        Of the pokes ``(n_modes,)``.
    frames
        Frames at each gain.
    steps
        Takes down what was tried, as it goes.

    Raises
    ------
    CalibrationError
        The sensor does not answer the pokes as the matrix says, or the loop closes at no gain; says
        what was seen.
    """
    loop.control.set_gain(_OPEN_LOOP_GAIN)
    open_segment, mean_gain, _ = yield from _measure_at_gain(
        loop, amplitude, frames, "open loop", _OPEN_LOOP_GAIN, steps
    )
    if open_segment.diverged:
        raise CalibrationError("the pokes alone hold the mirror at its limits; use smaller ones")
    if mean_gain is None:
        raise CalibrationError(
            "the loop cannot be closed: with this matrix the pokes have no answer "
            f"({open_segment.reason or 'noise'}). Measure the matrix again, with more frames, or use larger pokes"
        )
    if mean_gain[0] < 0:
        raise CalibrationError(
            f"the loop cannot be closed: the sensor answers the pokes with {mean_gain[0]:.2g} of what the "
            "matrix says; a sign is wrong (of the matrix, or of the mirror), or the pupil is flipped"
        )
    if open_segment.gains is not None:
        _require_consistent_signs(open_segment.gains)
    search = _GainSearch(target_gain, open_segment.residual_nm / mean_gain[0])
    gain = _FIRST_GAIN_FRACTION * target_gain / mean_gain[0]
    for _ in range(_MAX_TRIALS):
        loop.control.set_gain(gain)
        segment, mean_gain, residual = yield from _measure_at_gain(
            loop, amplitude, frames, f"first closure at gain {gain:.3g}", gain, steps
        )
        if search.update(gain, segment, mean_gain, residual):
            break
        if search.failed:
            # What a loop beyond its limit left on the mirror is no place to start from.
            loop.open_loop()
        gain = search.next_gain(gain)
    return search.best_closure(loop, steps)


def _require_consistent_signs(gains: OpticalGainEstimate) -> None:
    """Raise :class:`CalibrationError` unless most modes answer alike.

    Optical gains differ by some ten percent between modes. A matrix that belongs to another state of the
    bench has no such answer: its modes' gains are what chance makes of them, of either sign.
    """
    value, sigma = gains.value[0], gains.sigma[0]
    wrong = int(np.count_nonzero(value < -_WRONG_SIGN_SIGMA * sigma))
    scatter = math.sqrt(max(float(np.var(value) - np.mean(sigma**2)), 0.0))
    if wrong > _MAX_WRONG_SIGN_FRACTION * value.size or scatter > float(np.mean(value)):
        raise CalibrationError(
            f"the loop cannot be closed: {wrong} of {value.size} modes answer with the opposite sign, and "
            f"the modes' gains scatter by {scatter:.2g} about {np.mean(value):.2g}. The matrix belongs to "
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
    """Measure at a gain: mean optical gain and error if the answer is clear, residual in nm."""
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
    """The gains tried so far, and the next one."""

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
        """Take what a gain gave; true when it is the one."""
        least = self._open_nm if self._best_closure is None else self._best_closure.residual_nm
        self.failed = segment.diverged or not residual <= _RESIDUAL_INCREASE * least
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
        # Between the last good gain and one that was too high, halfway; close to it, that will do.
        bracketed = self._next_gain >= self._unstable_gain and gain > 0.7 * self._unstable_gain
        return within_tolerance or bracketed

    def next_gain(self, gain: float) -> float:
        """The gain to try next."""
        if self._next_gain >= self._unstable_gain:
            return float(np.sqrt(gain * self._unstable_gain))
        return self._next_gain

    def best_closure(self, loop: GainMeasurementLoop, steps: list[ClosureStep]) -> LoopClosure:
        """The gain that closed the loop.

        Raises
        ------
        CalibrationError
            None did.
        """
        best = self._best_closure
        if best is None or best.residual_nm > _CLOSED_RESIDUAL_RATIO * self._open_nm:
            tried_gains = ", ".join(f"{step.gain:.3g}" for step in steps[1:])
            observed = (
                "none was stable" if best is None else f"the least residual was {best.residual_nm:.0f} nm"
            )
            raise CalibrationError(
                f"the loop does not close: gains {tried_gains} were tried; {observed}, {self._open_nm:.0f} nm in open "
                "loop. The turbulence may be beyond the sensor's range (raise sensor.modulation), the matrix "
                "too noisy (drop more modes, loop.dropped_modes), or of another state of the bench"
            )
        loop.control.set_gain(best.gain)
        return best
