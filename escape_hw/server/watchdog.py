"""Verdicts on the engine's state: when the mirror has to be made safe."""

from __future__ import annotations

import statistics
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from escape_hw.config.server_models import ServerSection
from escape_hw.remote.state import State

#: Seconds over which the present and the usual residual are taken, and those without which none is judged.
_NOW_S, _USUAL_S, _LEAST_S = 1.0, 30.0, 4.0
#: A residual that follows the one before sooner is left out: states told out of turn weigh no more.
_SOONEST_S = 0.1


@dataclass(frozen=True, slots=True)
class Verdict:
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
        self._still_since: float | None = None
        self._clipped_since: float | None = None
        self._diverging_since: float | None = None
        #: Residuals and when they were told.
        self._residuals: deque[tuple[float, float]] = deque()
        #: Whether a loop is closed, by which run, and after how many flattenings of the mirror: a run may
        #: close its own, or close it again, before anybody sees one open.
        self._loop: tuple[bool, int | None, int] = (False, None, 0)

    def judge(self, state: State) -> Verdict | None:
        """The verdict on a state; ``None``: all is well."""
        if state.fault is not None:
            return None
        run = None if state.procedure is None else state.procedure.id
        loop = state.loop.closed, run, state.mirror.flattened
        if loop != self._loop:
            self._loop = loop
            self._residuals.clear()
            self._still_since = self._clipped_since = self._diverging_since = None
        return self._frames_arrive(state) or self._clipping(state) or self._diverging(state)

    def _frames_arrive(self, state: State) -> Verdict | None:
        now, limit = self._clock(), self._limits.no_frames_s
        if state.rates.frames != self._frames or not state.loop.closed:
            self._frames, self._still_since = state.rates.frames, None
            return None
        if self._still_since is None:
            self._still_since = now
        silent = now - self._still_since
        if silent <= limit:
            return None
        return Verdict(
            f"no frame for {silent:.1f} s in closed loop (limit {limit:g} s)",
            "look at the sensor's camera and its cable, then clear the fault",
        )

    def _clipping(self, state: State) -> Verdict | None:
        now, limit, most = self._clock(), self._limits.saturated_s, self._limits.saturated_share
        if not state.loop.closed or state.mirror.clipped <= most:
            self._clipped_since = None
            return None
        if self._clipped_since is None:
            self._clipped_since = now
        if now - self._clipped_since <= limit:
            return None
        return Verdict(
            f"{100 * state.mirror.clipped:.0f} % of the actuators at their limits for "
            f"{now - self._clipped_since:.1f} s (limit {100 * most:.0f} % for {limit:g} s)",
            "lower the gain, take another matrix, or wait for better seeing; then clear the fault",
        )

    def _diverging(self, state: State) -> Verdict | None:
        if not state.loop.closed or state.loop.residual_nm <= 0:
            return None
        now, told = self._clock(), self._residuals
        if told and (state.loop.residual_nm == told[-1][1] or now - told[-1][0] < _SOONEST_S):
            # No frame since the last state: a procedure that closes a loop of its own has not begun with it.
            return None
        told.append((now, state.loop.residual_nm))
        while now - told[0][0] > _USUAL_S:
            told.popleft()
        before = [residual for at, residual in told if now - at >= _NOW_S]
        if now - told[0][0] < _LEAST_S or not before:
            return None
        present = statistics.median(residual for at, residual in told if now - at < _NOW_S)
        usual = statistics.median(before)
        factor, limit = self._limits.diverging_factor, self._limits.diverging_s
        if present <= factor * usual:
            self._diverging_since = None
            return None
        if self._diverging_since is None:
            self._diverging_since = now
        if now - self._diverging_since < limit:
            return None
        return Verdict(
            f"the residual grew to {present:.0f} nm, {present / usual:.1f} times the usual {usual:.0f} nm "
            f"(limit {factor:g} times for {limit:g} s)",
            "lower the gain or take another matrix, then clear the fault",
        )
