"""Alarms on the state of a server: limits, and which of them are exceeded. No widgets."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import datetime

from escape_hw.api.tracking import DRIFT
from escape_hw.remote.state import State

log = logging.getLogger(__name__)
#: States in a row that exceed a limit before its alarm is raised: a second.
_STATES = 5


@dataclass(frozen=True, slots=True)
class AlarmRule:
    """A quantity that can raise an alarm."""

    name: str
    label: str
    unit: str
    #: Whether values below the limit raise the alarm.
    below: bool
    #: Range and default of the limit.
    low: float
    high: float
    default: float
    #: The quantity in a state; ``None`` while it is not measured.
    value: Callable[[State], float | None]

    def is_exceeded(self, value: float, limit: float) -> bool:
        """Whether a value is beyond the limit."""
        return value < limit if self.below else value > limit

    def describe(self, value: float, limit: float) -> str:
        """Words for a value beyond the limit."""
        side = "below" if self.below else "above"
        return f"{self.label} {value:.4g} {self.unit}, {side} {limit:g} {self.unit}"


def _strehl(state: State) -> float | None:
    return None if state.loop.strehl is None or not state.loop.closed else 100 * state.loop.strehl


def _residual(state: State) -> float | None:
    return state.loop.residual_nm if state.loop.closed and state.loop.residual_nm > 0 else None


def _lost_frames(state: State) -> float | None:
    return state.rates.lost_frames


def _saturation(state: State) -> float | None:
    return 100 * state.illumination.saturated


def _drift(state: State) -> float | None:
    """Of the registration, while the tracker runs."""
    return None if state.active_run is None else state.active_run.metrics.get(DRIFT)


#: The rules, in the order of the dialog.
RULES = (
    AlarmRule("strehl", "Strehl ratio", "%", True, 0, 100, 20, _strehl),
    AlarmRule("residual", "Residual", "nm rms", False, 0, 10_000, 200, _residual),
    AlarmRule("lost", "Lost frames", "frames", False, 0, 1_000_000, 100, _lost_frames),
    AlarmRule("saturated", "Saturated pixels", "%", False, 0, 100, 1, _saturation),
    AlarmRule("drift", "Registration drift", "% of a sub-aperture", False, 0, 10_000, 20, _drift),
)


class LimitMonitor:
    """Raises alarms from states; an alarm stays until it was acknowledged and its reason has passed.

    ``limits``: limit by name of the rule; rules without a limit are off. The mapping may change. ``on_event``
    is called with a text when an alarm is raised or acknowledged.
    """

    def __init__(
        self, limits: Mapping[str, float], on_event: Callable[[str], object] = lambda text: None
    ) -> None:
        self._limits, self._on_event = limits, on_event
        self._counts = dict.fromkeys((rule.name for rule in RULES), 0)
        self._raised: dict[str, str] = {}
        self._acknowledged: set[str] = set()
        self._serial = -1

    @property
    def unacknowledged(self) -> tuple[str, ...]:
        """Texts of the alarms that nobody has acknowledged."""
        return tuple(text for name, text in self._raised.items() if name not in self._acknowledged)

    def update(self, state: State) -> None:
        """Evaluate a new state."""
        if state.serial == self._serial:
            return
        self._serial = state.serial
        for rule in RULES:
            limit, value = self._limits.get(rule.name), rule.value(state)
            if limit is None or value is None or not rule.is_exceeded(value, limit):
                self._counts[rule.name] = 0
                if rule.name in self._acknowledged:
                    del self._raised[rule.name]
                    self._acknowledged.discard(rule.name)
                continue
            self._counts[rule.name] += 1
            if self._counts[rule.name] >= _STATES and rule.name not in self._raised:
                self._raised[rule.name] = f"{rule.describe(value, limit)}, since {datetime.now():%H:%M:%S}"
                log.warning("ALARM: %s", self._raised[rule.name])
                self._on_event(self._raised[rule.name])

    def acknowledge(self) -> None:
        """Acknowledge all alarms."""
        for text in self.unacknowledged:
            log.warning("acknowledged: %s", text)
            self._on_event(f"acknowledged: {text}")
        self._acknowledged |= self._raised.keys()
