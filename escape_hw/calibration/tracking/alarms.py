"""Alarms of the tracker: changes of the system that a new registration does not explain."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np

from escape_hw.api.registration import Registration
from escape_hw.api.results import TemporalResponse
from escape_hw.api.tracking import Alarm
from escape_hw.calibration.docrime.response import responses_differ
from escape_hw.calibration.tracking.live_registration import LiveEstimate

#: Innovation of an update, in standard errors, above which the registration has jumped.
INNOVATION_LIMIT = 8.0
#: Misfit and noise of an update, relative to their medians, above which the model does not fit or the slopes
#: are too noisy.
MISFIT_FACTOR, NOISE_FACTOR = 2.5, 2.0
#: Relative gain of an actuator, beyond the common one, that raises an alarm, and least change of it since
#: the calibration, which names weak actuators itself.
ACTUATOR_GAIN_LIMIT, ACTUATOR_CHANGE_LIMIT = 0.5, 0.2
#: Updates after an alarm without an exchange, and in which an alarm of the same kind is not repeated.
QUIET_UPDATES = 5
#: Updates of the running medians.
_BASELINE_UPDATES = 30


class AlarmMonitor:
    """Checks every update for changes that a new registration does not explain.

    ``start`` and ``response`` are registration and temporal response at the start; a shift of the mirror
    above ``max_shift`` [% of a sub-aperture] needs a new calibration.
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
        """Whether the last updates raised no alarm."""
        return all(self._updates - at > QUIET_UPDATES for at in self._last.values())

    def check(self, live: LiveEstimate, seconds: float) -> list[Alarm]:
        """New alarms of an update; an alarm of a kind that was raised recently is not repeated."""
        self._updates += 1
        new_alarms = []
        for kind, text in self._find_anomalies(live).items():
            if self._updates - self._last.get(kind, -2 * QUIET_UPDATES) > QUIET_UPDATES:
                new_alarms.append(Alarm(seconds, kind, text))
            self._last[kind] = self._updates
        if not new_alarms:
            self._noise.append(live.noise)
            self._misfit.append(live.misfit)
        # A changed response is reported once, because later updates use it.
        self._response = live.response
        return new_alarms

    def _find_anomalies(self, live: LiveEstimate) -> dict[str, str]:
        new_alarms = {}
        if live.innovation > INNOVATION_LIMIT:
            new_alarms["jump"] = (
                f"registration or gain jumped by {live.innovation:.1f} standard errors within one update; "
                "the live registration is restarted"
            )
        misfit = _baseline(self._misfit)
        if live.misfit > MISFIT_FACTOR * max(misfit, 1.0):
            new_alarms["misfit"] = (
                f"no registration explains the response of the slopes to the pokes (mean square misfit "
                f"{live.misfit:.2f} of the noise, usually {misfit:.2f}); check for dead actuators, a changed "
                "flip, or lost light"
            )
        baseline = _baseline(self._noise)
        if live.noise > NOISE_FACTOR * baseline:
            new_alarms["noise"] = (
                f"the noise of the slopes is {live.noise / baseline:.1f} times as large as usual; check for "
                "low light and vibrations"
            )
        if self._response is not None and responses_differ(live.response, self._response):
            new_alarms["delay"] = (
                f"the delay is {live.response.delay_frames:.2f} frames instead of "
                f"{self._response.delay_frames:.2f}; check exposure, frame rate, and the latency of "
                "the computer"
            )
        changed = np.abs(live.actuator_gain_changes) > ACTUATOR_CHANGE_LIMIT
        gains = np.where(changed, live.actuator_gains, 0.0)
        worst = int(np.argmax(np.abs(gains)))
        if abs(gains[worst]) > ACTUATOR_GAIN_LIMIT:
            new_alarms["actuator"] = (
                f"actuator {worst} has {1 + gains[worst]:.0%} of the gain of the others; "
                "check it, and disable it (devices.dm.limits.disabled) if it is dead"
            )
        moved = float(np.abs(live.registration.registration.to_array() - self._start)[:2].max())
        if moved > self._max_shift:
            new_alarms["limit"] = (
                f"the mirror has shifted by {moved:.0f} % of a sub-aperture since the start, more than "
                f"tracking.max_shift ({self._max_shift:g}); calibrate again"
            )
        return new_alarms


def _baseline(values: Sequence[float]) -> float:
    """Median of the recent values; infinite while there are too few."""
    return float(np.median(values)) if len(values) >= QUIET_UPDATES else float(np.inf)
