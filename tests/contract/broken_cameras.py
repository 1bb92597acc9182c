"""Every check on cameras fails on a camera that violates only the checked rule."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from broken import Broken

from escape_hw.api.camera import Camera
from escape_hw.errors import DeviceError, FrameTimeout
from escape_hw.testing.reference_devices import SyntheticCamera


def frames_with(**changes: Callable[[Any], Any]) -> Callable[..., Any]:
    """Make a ``_next_frame`` that alters the reference camera's frames."""

    def _next_frame(self: Any, timeout_s: float) -> Any:
        frame = SyntheticCamera._next_frame(self, timeout_s)
        return replace(frame, **{name: change(frame) for name, change in changes.items()})

    return _next_frame


def writable(frame: Any) -> Any:
    return frame.data.copy()


def frozen(data: Any) -> Any:
    data.setflags(write=False)
    return data


def checks_by_setting(self: Any, want: Any) -> Any:
    self._settings = SyntheticCamera._check(self, want)
    return self._settings


def drifts(self: Any, want: Any) -> Any:
    return replace(SyntheticCamera._check(self, want), gain_db=want.gain_db + 0.1)


def grows(self: Any, want: Any) -> Any:
    region = want.region
    width, height = (-(-side // self._STEP_PX) * self._STEP_PX for side in (region.width, region.height))
    return SyntheticCamera._check(self, replace(want, region=replace(region, width=width, height=height)))


def moves_outwards(self: Any, want: Any) -> Any:
    region = want.region
    return SyntheticCamera._check(self, replace(want, region=replace(region, x=region.x // 4 * 4)))


def never_right(self: Any, want: Any) -> Any:
    answer = SyntheticCamera._check(self, want)
    return replace(answer, exposure_s=1e-4 if answer.exposure_s == 1e-3 else 1e-3)


def takes_all(self: Any, want: Any) -> Any:
    self.require_open()
    return want


def lies(self: Any, want: Any) -> Any:
    Camera.configure(self, want)
    return want


def forgets_region(self: Any, settings: Any) -> None:
    self._settings = replace(settings, region=self._settings.region)


def stays_stopped(self: Any, want: Any) -> Any:
    self.stop()
    return Camera.configure(self, want)


def fails_twice(self: Any) -> None:
    if self._running:
        raise DeviceError(self.name, "runs already")
    Camera.start(self)


def keeps_counting(self: Any) -> None:
    self.require_open()
    if not self._running:
        self._start()
        self._running = True


def keeps_running(self: Any) -> None:
    """Close without stopping."""


def one_buffer(self: Any, timeout_s: float) -> Any:
    frame = SyntheticCamera._next_frame(self, timeout_s)
    if getattr(self, "buffer", None) is None or self.buffer.shape != frame.data.shape:
        self.buffer = frame.data.copy()
    self.buffer[:] = frame.data
    return replace(frame, data=frozen(self.buffer.view()))


def index_falls(self: Any, timeout_s: float) -> Any:
    frame = SyntheticCamera._next_frame(self, timeout_s)
    return replace(frame, index=1000 - frame.index)


def gives_none(self: Any, timeout_s: float) -> Any:
    try:
        return SyntheticCamera._next_frame(self, timeout_s)
    except FrameTimeout:
        return None


def waits_for_ever(self: Any, timeout_s: float) -> Any:
    return SyntheticCamera._next_frame(self, 1e6)


def waits_any_time(self: Any, timeout_s: float = 1.0) -> Any:
    return Camera.next_frame(self, timeout_s if 0 < timeout_s < 1e9 else 1.0)


def half_as_fast(self: Any) -> int:
    return int(2e9 / self._settings.frame_rate_hz)


def polls_patiently(self: Any) -> Any:
    return self._next_frame(1.0)


def polls_through_next_frame(self: Any) -> Any:
    try:
        return self.next_frame(1e-6)
    except FrameTimeout:
        return None


def miscounts(self: Any) -> Any:
    return replace(Camera.status(self), lost=3)


BROKEN: list[Broken] = [
    (
        "no serial",
        SyntheticCamera,
        "camera_info_is_complete",
        {"info": property(lambda self: replace(SyntheticCamera().info, serial=""))},
    ),
    ("settings out of reach", SyntheticCamera, "camera_settings_are_achievable", {"_check": never_right}),
    ("check drifts", SyntheticCamera, "camera_check_is_a_fixed_point", {"_check": drifts}),
    ("check sets", SyntheticCamera, "camera_check_changes_nothing", {"_check": checks_by_setting}),
    ("region grows", SyntheticCamera, "camera_regions_do_not_grow", {"_check": grows}),
    ("region moves", SyntheticCamera, "camera_regions_do_not_grow", {"_check": moves_outwards}),
    ("any region", SyntheticCamera, "camera_refuses_regions_off_the_sensor", {"check": takes_all}),
    ("any settings", SyntheticCamera, "camera_refuses_meaningless_settings", {"check": takes_all}),
    ("configure lies", SyntheticCamera, "camera_configure_reports_actual_settings", {"configure": lies}),
    (
        "region ignored",
        SyntheticCamera,
        "camera_configure_reports_actual_settings",
        {"_configure": forgets_region},
    ),
    ("stays stopped", SyntheticCamera, "camera_configures_while_running", {"configure": stays_stopped}),
    ("starts once", SyntheticCamera, "camera_start_and_stop_repeat", {"start": fails_twice}),
    ("keeps counting", SyntheticCamera, "camera_restart_resets_counters", {"start": keeps_counting}),
    ("keeps running", SyntheticCamera, "camera_closes_while_running", {"_before_close": keeps_running}),
    (
        "wrong type",
        SyntheticCamera,
        "camera_frames_are_well_formed",
        {"_next_frame": frames_with(data=lambda f: frozen(f.data.astype(np.int32)))},
    ),
    (
        "wrong shape",
        SyntheticCamera,
        "camera_frames_are_well_formed",
        {"_next_frame": frames_with(data=lambda f: f.data.T)},
    ),
    (
        "writable",
        SyntheticCamera,
        "camera_frames_are_well_formed",
        {"_next_frame": frames_with(data=writable)},
    ),
    (
        "beyond the scale",
        SyntheticCamera,
        "camera_frames_are_well_formed",
        {"_next_frame": frames_with(data=lambda f: frozen(f.data + np.uint16(1000)))},
    ),
    (
        "saturation not counted",
        SyntheticCamera,
        "camera_frames_are_well_formed",
        {"_next_frame": frames_with(data=lambda f: frozen(np.full_like(f.data, 1023)))},
    ),
    ("one buffer", SyntheticCamera, "camera_frames_are_not_overwritten", {"_next_frame": one_buffer}),
    ("index falls", SyntheticCamera, "camera_index_and_time_rise", {"_next_frame": index_falls}),
    (
        "arrives early",
        SyntheticCamera,
        "camera_index_and_time_rise",
        {"_next_frame": frames_with(arrived_ns=lambda f: f.exposed_ns - 1)},
    ),
    ("half the rate", SyntheticCamera, "camera_rate_is_as_stated", {"_period_ns": property(half_as_fast)}),
    ("miscounts", SyntheticCamera, "camera_counts_add_up", {"status": miscounts}),
    ("any time-out", SyntheticCamera, "camera_refuses_timeouts", {"next_frame": waits_any_time}),
    ("gives None", SyntheticCamera, "camera_raises_timeout", {"_next_frame": gives_none}),
    ("poll waits", SyntheticCamera, "camera_polls_without_waiting", {"_poll": polls_patiently}),
    ("poll counts", SyntheticCamera, "camera_polls_without_waiting", {"poll": polls_through_next_frame}),
    ("waits for ever", SyntheticCamera, "camera_raises_timeout", {"_next_frame": waits_for_ever}),
]
