"""Alarms of the tracker: what a new registration does not explain."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np

from escape_hw.api.registration import Registration
from escape_hw.api.results import TemporalResponse
from escape_hw.api.tracking import Alarm
from escape_hw.calibration.docrime.response import responses_differ
from escape_hw.calibration.tracking.live_registration import LiveEstimate

#: Standard errors that an update may miss what was expected by.
INNOVATION_LIMIT = 8.0
#: Mean square misfit of an update's own frames beside the usual from which on the model does not hold; and
#: how loud they may be beside the usual.
MISFIT_FACTOR, NOISE_FACTOR = 2.5, 2.0
#: An actuator that answers by less or more than this beside the others is not what the model takes it for.
ACTUATOR_GAIN_LIMIT = 0.5
#: Updates after an alarm in which nothing is exchanged, and which alarms of one kind are one.
QUIET_UPDATES = 5
#: Updates that tell what is usual.
_BASELINE_UPDATES = 30


class AlarmMonitor:
    """Looks at every update.

    Parameters
    ----------
    start
        Registration that tracking began with.
    max_shift
        How far the mirror may shift before a new calibration is due, % of a sub-aperture.
    response
        The temporal response that the matrix was measured with, where it is known.
    """

    def __init__(
        self, start: Registration, max_shift: float, response: TemporalResponse | None = None
    ) -> None:
        self._start, self._max_shift, self._response = start.to_array(), max_shift, response
        self._noise: deque[float] = deque(maxlen=_BASELINE_UPDATES)
        self._misfit: deque[float] = deque(maxlen=_BASELINE_UPDATES)
        self._last: dict[str, int] = {}
        self._updates = 0

    @property
    def is_quiet(self) -> bool:
        """Whether there was no alarm lately."""
        return all(self._updates - at > QUIET_UPDATES for at in self._last.values())

    def check(self, live: LiveEstimate, seconds: float) -> list[Alarm]:
        """New alarms of an update; one of a kind that is on already is not repeated."""
        self._updates += 1
        new_alarms = []
        for kind, text in self._find_anomalies(live).items():
            if self._updates - self._last.get(kind, -2 * QUIET_UPDATES) > QUIET_UPDATES:
                new_alarms.append(Alarm(seconds, kind, text))
            self._last[kind] = self._updates
        if not new_alarms:
            self._noise.append(live.noise)
            self._misfit.append(live.misfit)
        # The live registration goes on with the response that it measures: told once.
        self._response = live.response
        return new_alarms

    def _find_anomalies(self, live: LiveEstimate) -> dict[str, str]:
        new_alarms = {}
        if live.surprise > INNOVATION_LIMIT:
            new_alarms["jump"] = (
                f"registration or gain jumped by {live.surprise:.1f} standard errors within one update; "
                "the live registration starts anew"
            )
        misfit = _baseline(self._misfit)
        if live.misfit > MISFIT_FACTOR * max(misfit, 1.0):
            new_alarms["misfit"] = (
                f"the slopes do not follow the pokes as any registration would have it (mean square misfit "
                f"{live.misfit:.2f} of the noise, usually {misfit:.2f}); look for dead actuators, a changed "
                "flip, lost light"
            )
        baseline = _baseline(self._noise)
        if live.noise > NOISE_FACTOR * baseline:
            new_alarms["noise"] = (
                f"the slopes move {live.noise / baseline:.1f} times as much as usual beyond what the mirror "
                "explains; is there enough light, or does something vibrate?"
            )
        if self._response is not None and responses_differ(live.response, self._response):
            new_alarms["delay"] = (
                f"the mirror answers after {live.response.delay:.2f} frames, not {self._response.delay:.2f}; "
                "look for another exposure or frame rate, or a computer that is late"
            )
        worst = int(np.argmax(np.abs(live.actuator_gains)))
        if abs(live.actuator_gains[worst]) > ACTUATOR_GAIN_LIMIT:
            new_alarms["actuator"] = (
                f"actuator {worst} answers by {1 + live.actuator_gains[worst]:.0%} of the others; check it, and "
                "disable it (devices.dm.limits.disabled) if it is dead"
            )
        moved = float(np.abs(live.registration.registration.to_array() - self._start)[:2].max())
        if moved > self._max_shift:
            new_alarms["limit"] = (
                f"the mirror has shifted by {moved:.0f} % of a sub-aperture since the start, more than "
                f"tracking.max_shift ({self._max_shift:g}); calibrate anew"
            )
        return new_alarms


def _baseline(values: Sequence[float]) -> float:
    """Median of what was seen lately; infinite before there is enough of it."""
    return float(np.median(values)) if len(values) >= QUIET_UPDATES else float(np.inf)
