"""Closing the loop for the first time, with a matrix whose scale nobody knows."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.gains import ClosureStep
from escape_hw.api.procedure import Procedure
from escape_hw.calibration.gain_loop import GainLoop, Stretch
from escape_hw.calibration.gain_meter import MeasuredGains
from escape_hw.errors import CalibrationError

#: Gain of the integrator at which the loop is as good as open.
_OPEN = 1e-6
#: Share of the wanted gain at which it closes first, counted by the optical gain of the open loop: that
#: rises as the turbulence goes, up to threefold.
_CAREFUL = 0.2
#: The gain is found when it is within this share of the wanted one.
_NEAR = 0.2
#: Largest step of the gain up, and the step down when the loop got worse.
_UP, _DOWN = 2.0, 0.4
#: Residual relative to the best so far that counts as worse.
_WORSE = 1.3
#: Residual relative to the open loop's below which the loop counts as closed.
_CLOSED = 0.9
#: Gains tried at most.
_MOST = 14
#: Standard errors by which the optical gain must differ from none.
_CLEARLY = 5.0
#: Share of the modes that may answer with the opposite sign, by so many standard errors.
_WRONG, _SURELY = 0.15, 3.0


@dataclass(frozen=True, slots=True, eq=False)
class Closure:
    """A loop that was closed: with which gain of the integrator, and what was measured there."""

    gain: float
    gains: MeasuredGains
    residual_nm: float


def close_first(
    loop: GainLoop,
    wanted: float,
    amplitude: NDArray[np.float64],
    frames: int,
    steps: list[ClosureStep],
) -> Procedure[Closure]:
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
    loop.control.set_gain(_OPEN)
    opened, answer, _ = yield from _look(loop, amplitude, frames, "open loop", _OPEN, steps)
    if opened.diverged:
        raise CalibrationError("the pokes alone hold the mirror at its limits; use smaller ones")
    if answer is None:
        raise CalibrationError(
            "the loop cannot be closed: with this matrix the pokes have no answer "
            f"({opened.why or 'noise'}). Measure the matrix again, with more frames, or use larger pokes"
        )
    if answer[0] < 0:
        raise CalibrationError(
            f"the loop cannot be closed: the sensor answers the pokes with {answer[0]:.2g} of what the "
            "matrix says; a sign is wrong (of the matrix, or of the mirror), or the pupil is flipped"
        )
    if opened.gains is not None:
        _require_agreement(opened.gains)
    search = _Search(wanted, opened.residual_nm / answer[0])
    gain = _CAREFUL * wanted / answer[0]
    for _ in range(_MOST):
        loop.control.set_gain(gain)
        stretch, answer, residual = yield from _look(
            loop, amplitude, frames, f"first closure at gain {gain:.3g}", gain, steps
        )
        if search.took(gain, stretch, answer, residual):
            break
        if search.failed:
            # What a loop beyond its limit left on the mirror is no place to start from.
            loop.open_again()
        gain = search.following(gain)
    return search.found(loop, steps)


def _require_agreement(gains: MeasuredGains) -> None:
    """Raise :class:`CalibrationError` unless most modes answer alike.

    Optical gains differ by some ten percent between modes. A matrix that belongs to another state of the
    bench has no such answer: its modes' gains are what chance makes of them, of either sign.
    """
    value, sigma = gains.value[0], gains.sigma[0]
    wrong = int(np.count_nonzero(value < -_SURELY * sigma))
    scatter = math.sqrt(max(float(np.var(value) - np.mean(sigma**2)), 0.0))
    if wrong > _WRONG * value.size or scatter > float(np.mean(value)):
        raise CalibrationError(
            f"the loop cannot be closed: {wrong} of {value.size} modes answer with the opposite sign, and "
            f"the modes' gains scatter by {scatter:.2g} about {np.mean(value):.2g}. The matrix belongs to "
            "another state of the bench (registration, flip or rotation of the pupil); measure it again"
        )


def _look(
    loop: GainLoop,
    amplitude: NDArray[np.float64],
    frames: int,
    stage: str,
    gain: float,
    steps: list[ClosureStep],
) -> Procedure[tuple[Stretch, tuple[float, float] | None, float]]:
    """Measure at a gain: mean optical gain and error if the answer is clear, residual in nm."""
    stretch = yield from loop.measure(frames, amplitude, stage, most=3 * frames, enough=_clear)
    answer = stretch.gains.mean() if stretch.gains is not None and _clear(stretch.gains) else None
    residual = stretch.residual_nm / abs(answer[0]) if answer is not None else math.inf
    shown = answer if answer is not None else (math.nan, math.nan)
    steps.append(ClosureStep(gain, *shown, residual, not stretch.diverged))
    return stretch, answer, residual


def _clear(gains: MeasuredGains) -> bool:
    value, sigma = gains.mean()
    return abs(value) > _CLEARLY * sigma


class _Search:
    """The gains tried so far, and the next one."""

    def __init__(self, wanted: float, open_nm: float) -> None:
        self._wanted, self._open_nm = wanted, open_nm
        self._too_high = math.inf
        self._best: Closure | None = None
        self._next = 0.0
        #: Whether the last gain was too high.
        self.failed = False

    def took(
        self, gain: float, stretch: Stretch, answer: tuple[float, float] | None, residual: float
    ) -> bool:
        """Take what a gain gave; true when it is the one."""
        least = self._open_nm if self._best is None else self._best.residual_nm
        self.failed = stretch.diverged or not residual <= _WORSE * least
        if self.failed or stretch.gains is None or answer is None:
            self._too_high = min(self._too_high, gain)
            self._next = gain * _DOWN
            return False
        effective = gain * answer[0]
        if self._best is None or residual < self._best.residual_nm:
            self._best = Closure(gain, stretch.gains, residual)
        near = abs(effective / self._wanted - 1) < _NEAR
        if near:
            self._best = Closure(gain, stretch.gains, residual)
        self._next = gain * float(np.clip(self._wanted / effective, _DOWN, _UP))
        # Between the last good gain and one that was too high, halfway; close to it, that will do.
        stuck = self._next >= self._too_high and gain > 0.7 * self._too_high
        return near or stuck

    def following(self, gain: float) -> float:
        """The gain to try next."""
        if self._next >= self._too_high:
            return float(np.sqrt(gain * self._too_high))
        return self._next

    def found(self, loop: GainLoop, steps: list[ClosureStep]) -> Closure:
        """The gain that closed the loop.

        Raises
        ------
        CalibrationError
            None did.
        """
        best = self._best
        if best is None or best.residual_nm > _CLOSED * self._open_nm:
            tried = ", ".join(f"{step.gain:.3g}" for step in steps[1:])
            seen = "none was stable" if best is None else f"the least residual was {best.residual_nm:.0f} nm"
            raise CalibrationError(
                f"the loop does not close: gains {tried} were tried; {seen}, {self._open_nm:.0f} nm in open "
                "loop. The turbulence may be beyond the sensor's range (raise sensor.modulation), the matrix "
                "too noisy (drop more modes, loop.dropped_modes), or of another state of the bench"
            )
        loop.control.set_gain(best.gain)
        return best
