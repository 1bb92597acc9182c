"""Verdicts on the engine's state: when the mirror has to be made safe."""

from __future__ import annotations

import statistics
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from escape_hw.config.system import ServerSection
from escape_hw.remote.state import State

#: Seconds over which the present and the usual residual are taken, and those without which none is judged.
_RECENT_S, _BASELINE_S, _MIN_HISTORY_S = 1.0, 30.0, 4.0
#: A residual that follows the one before sooner is left out: states told out of turn weigh no more.
_MIN_SPACING_S = 0.1


@dataclass(frozen=True, slots=True)
class LimitViolation:
    """Why the mirror has to be made safe, and what the operator can do then."""

    reason: str
    way_out: str


class Watchdog:
    """Looks at every state of an engine.

    Parameters
    ----------
    limits
        The configured limits.
    clock
        Monotonic seconds.
    """

    def __init__(self, limits: ServerSection, clock: Callable[[], float] = time.monotonic) -> None:
        self._limits, self._clock = limits, clock
        self._frames = -1
        #: Since when something was seen to be so, state after state. What was not told is held against
        #: nobody: this process itself may have been held up.
        self._no_frames_since: float | None = None
        self._clipped_since: float | None = None
        self._diverging_since: float | None = None
        #: Residuals and when they were told.
        self._residuals: deque[tuple[float, float]] = deque()
        #: Whether a loop is closed, by which run, and after how many flattenings of the mirror: a run may
        #: close its own, or close it again, before anybody sees one open.
        self._loop: tuple[bool, int | None, int] = (False, None, 0)

    def check(self, state: State) -> LimitViolation | None:
        """The verdict on a state; ``None``: all is well."""
        if state.fault is not None:
            return None
        run = None if state.procedure is None else state.procedure.id
        loop = state.loop.closed, run, state.mirror.flattened
        if loop != self._loop:
            self._loop = loop
            self._residuals.clear()
            self._no_frames_since = self._clipped_since = self._diverging_since = None
        return self._check_frames(state) or self._check_saturation(state) or self._check_divergence(state)

    def _check_frames(self, state: State) -> LimitViolation | None:
        now, limit = self._clock(), self._limits.no_frames_s
        if state.rates.frames != self._frames or not state.loop.closed:
            self._frames, self._no_frames_since = state.rates.frames, None
            return None
        if self._no_frames_since is None:
            self._no_frames_since = now
        silent = now - self._no_frames_since
        if silent <= limit:
            return None
        return LimitViolation(
            f"no frame for {silent:.1f} s in closed loop (limit {limit:g} s)",
            "look at the sensor's camera and its cable, then clear the fault",
        )

    def _check_saturation(self, state: State) -> LimitViolation | None:
        now, limit, max_share = self._clock(), self._limits.saturated_s, self._limits.saturated_fraction
        if not state.loop.closed or state.mirror.clipped <= max_share:
            self._clipped_since = None
            return None
        if self._clipped_since is None:
            self._clipped_since = now
        if now - self._clipped_since <= limit:
            return None
        return LimitViolation(
            f"{100 * state.mirror.clipped:.0f} % of the actuators at their limits for "
            f"{now - self._clipped_since:.1f} s (limit {100 * max_share:.0f} % for {limit:g} s)",
            "lower the gain, take another matrix, or wait for better seeing; then clear the fault",
        )

    def _check_divergence(self, state: State) -> LimitViolation | None:
        if not state.loop.closed or state.loop.residual_nm <= 0:
            return None
        now, samples = self._clock(), self._residuals
        if samples and (state.loop.residual_nm == samples[-1][1] or now - samples[-1][0] < _MIN_SPACING_S):
            # No frame since the last state: a procedure that closes a loop of its own has not begun with it.
            return None
        samples.append((now, state.loop.residual_nm))
        while now - samples[0][0] > _BASELINE_S:
            samples.popleft()
        baseline_residuals = [residual for at, residual in samples if now - at >= _RECENT_S]
        if now - samples[0][0] < _MIN_HISTORY_S or not baseline_residuals:
            return None
        present = statistics.median(residual for at, residual in samples if now - at < _RECENT_S)
        baseline = statistics.median(baseline_residuals)
        factor, limit = self._limits.diverging_factor, self._limits.diverging_s
        if present <= factor * baseline:
            self._diverging_since = None
            return None
        if self._diverging_since is None:
            self._diverging_since = now
        if now - self._diverging_since < limit:
            return None
        return LimitViolation(
            f"the residual grew to {present:.0f} nm, {present / baseline:.1f} times the usual {baseline:.0f} nm "
            f"(limit {factor:g} times for {limit:g} s)",
            "lower the gain or take another matrix, then clear the fault",
        )
