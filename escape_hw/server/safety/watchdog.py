"""Limits on the engine's state in closed loop; the mirror is made safe when one is exceeded."""

from __future__ import annotations

import statistics
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from escape_hw.config.system import ServerSection
from escape_hw.remote.state import State

#: Seconds of the present residual, of its baseline, and of the shortest history that is checked.
_RECENT_S, _BASELINE_S, _MIN_HISTORY_S = 1.0, 30.0, 4.0
#: Least interval of residuals; states that are published in between are ignored.
_MIN_SPACING_S = 0.1
#: A loop starts with this number of frames. Compiled code may be built at its first use, on a busy computer
#: for as long as this, seconds; the loop's own rules apply meanwhile.
_STARTING_FRAMES, _STARTING_LIMIT_S = 200, 60.0


@dataclass(frozen=True, slots=True)
class LimitViolation:
    """A limit that is exceeded, and what the operator can do."""

    reason: str
    remedy: str


class _Duration:
    """Seconds for which a condition has held in every state.

    Gaps between states do not count towards the limits, since this process itself may have been delayed.
    """

    def __init__(self) -> None:
        self._since: float | None = None

    def update(self, holds: bool, now: float) -> float:
        if not holds:
            self._since = None
        elif self._since is None:
            self._since = now
        return 0.0 if self._since is None else now - self._since


class Watchdog:
    """Checks every state of the engine against the configured limits."""

    def __init__(self, limits: ServerSection, clock: Callable[[], float] = time.monotonic) -> None:
        self._limits, self._clock = limits, clock
        self._frames = -1
        #: Number of frames when the present loop began.
        self._first_frames = 0
        self._no_frames, self._clipped, self._diverging = _Duration(), _Duration(), _Duration()
        #: Times and residuals in nm.
        self._residuals: deque[tuple[float, float]] = deque()
        #: Identity of the closed loop: closed, run, and count of flattenings. A run may open and close the
        #: loop between two states.
        self._loop: tuple[bool, int | None, int] = (False, None, 0)

    def check(self, state: State) -> LimitViolation | None:
        """Check a state; returns the limit that it exceeds, or ``None``."""
        if state.fault is not None:
            return None
        run = None if state.active_run is None else state.active_run.id
        loop = state.loop.closed, run, state.mirror.flatten_count
        if loop != self._loop:
            self._loop = loop
            self._first_frames = state.rates.frames
            self._residuals.clear()
            self._no_frames, self._clipped, self._diverging = _Duration(), _Duration(), _Duration()
        return self._check_frames(state) or self._check_saturation(state) or self._check_divergence(state)

    def _check_frames(self, state: State) -> LimitViolation | None:
        now, limit = self._clock(), self._limits.no_frames_s
        if state.rates.frames - self._first_frames < _STARTING_FRAMES:
            limit = max(limit, _STARTING_LIMIT_S)
        silent = self._no_frames.update(state.loop.closed and state.rates.frames == self._frames, now)
        self._frames = state.rates.frames
        if silent <= limit:
            return None
        return LimitViolation(
            f"no frame for {silent:.1f} s in closed loop (limit {limit:g} s)",
            "Check the sensor's camera and its cable, then clear the fault.",
        )

    def _check_saturation(self, state: State) -> LimitViolation | None:
        now, limit, max_share = self._clock(), self._limits.saturated_s, self._limits.saturated_fraction
        clipped_s = self._clipped.update(state.loop.closed and state.mirror.saturated_share > max_share, now)
        if clipped_s <= limit:
            return None
        return LimitViolation(
            f"{100 * state.mirror.saturated_share:.0f} % of the actuators at their limits for "
            f"{clipped_s:.1f} s (limit {100 * max_share:.0f} % for {limit:g} s)",
            "Lower the gain, use another matrix, or wait for better seeing; then clear the fault.",
        )

    def _check_divergence(self, state: State) -> LimitViolation | None:
        if not state.loop.closed or state.loop.residual_nm <= 0:
            return None
        now, samples = self._clock(), self._residuals
        if samples and (state.loop.residual_nm == samples[-1][1] or now - samples[-1][0] < _MIN_SPACING_S):
            # No new residual: a procedure that closes the loop itself has not started to.
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
        diverges = present > factor * baseline
        if self._diverging.update(diverges, now) < limit or not diverges:
            return None
        return LimitViolation(
            f"the residual grew to {present:.0f} nm, {present / baseline:.1f} times its median of "
            f"{baseline:.0f} nm (limit {factor:g} times for {limit:g} s)",
            "Lower the gain or use another matrix, then clear the fault.",
        )
