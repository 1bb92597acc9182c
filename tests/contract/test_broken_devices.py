"""Who tests the tests: every check fails on a device that breaks just what it checks."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from escape_hw.api.camera import Camera
from escape_hw.api.device import Device
from escape_hw.api.mirror import DeformableMirror, DMInfo, SendReport
from escape_hw.errors import CommandRejected, DeviceError, FrameTimeout, NotOpen, SettingRejected
from escape_hw.safety.guard import GuardReport
from escape_hw.testing import checks_for, run_checks
from escape_hw.testing.reference import QuantisedModulator, RecordingMirror, SteadyScreen, SyntheticCamera

Broken = tuple[str, type[Device], str, dict[str, Any]]


def info_of(**changes: Any) -> property:
    """Make an ``info`` that differs from the reference mirror's."""
    return property(lambda self: replace(RecordingMirror.info.fget(self), **changes))  # type: ignore[attr-defined]


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


# --- devices in general -----------------------------------------------------------------------


def opens_itself(self: Any) -> None:
    SteadyScreen.__init__(self)
    self._is_open = True


def refuses_to_reopen(self: Any) -> None:
    self.opened = getattr(self, "opened", 0) + 1
    if self.opened > 1:
        raise DeviceError(self.name, "only once")


def swallows(self: Any, *error: Any) -> bool:
    self.close()
    return True


def sets_anyway(self: Any, **change: Any) -> Any:
    return self._state if not self.is_open else SteadyScreen.set(self, **change)


def unnamed_not_open(self: Any) -> None:
    if not self._is_open:
        raise NotOpen("device", "not open")


def falling_clock(self: Any) -> int:
    return -time.monotonic_ns()


GENERAL: list[Broken] = [
    ("opens itself", SteadyScreen, "construction_is_passive", {"__init__": opens_itself}),
    ("finaliser", SteadyScreen, "construction_is_passive", {"__del__": lambda self: None}),
    (
        "no name",
        SteadyScreen,
        "construction_is_passive",
        {"__init__": lambda self: SteadyScreen.__init__(self, "")},
    ),
    ("overrides send", RecordingMirror, "final_methods_are_kept", {"send": lambda self, c: self._send(c)}),
    ("opens once", SteadyScreen, "open_and_close_repeat", {"_open": refuses_to_reopen}),
    ("swallows errors", SteadyScreen, "context_manager", {"__exit__": swallows}),
    ("works while closed", SteadyScreen, "refuses_use_unless_open", {"set": sets_anyway}),
    ("does not say who", SteadyScreen, "refuses_use_unless_open", {"require_open": unnamed_not_open}),
    ("clock runs backwards", SteadyScreen, "clock_never_runs_backwards", {"now_ns": falling_clock}),
    (
        "clock in seconds",
        SteadyScreen,
        "clock_never_runs_backwards",
        {"now_ns": lambda self: time.monotonic()},
    ),
]

# --- mirrors ----------------------------------------------------------------------------------


def unguarded(self: Any, command: Any) -> Any:
    """Send without any guard, as a driver that overrides ``send`` might."""
    self.require_open()
    shape = np.asarray(command, dtype=float)
    self._send(shape)
    self._guard.last = shape
    self.sent_count += 1
    return SendReport(shape, self.now_ns(), GuardReport())


def knocks_first(self: Any, command: Any) -> Any:
    """Send what was asked for, and a moment later what the guard made of it."""
    self.require_open()
    self._send(np.asarray(command, dtype=float))
    return DeformableMirror.send(self, command)


def repairs_nan(self: Any, command: Any) -> Any:
    return DeformableMirror.send(self, np.nan_to_num(command))


def names_no_index(self: Any, command: Any) -> Any:
    try:
        return DeformableMirror.send(self, command)
    except CommandRejected:
        raise CommandRejected(self.name, "bad command") from None


def flattens_shape(self: Any, command: Any) -> Any:
    self.require_open()
    command = np.resize(np.asarray(command), self.info.n_act)
    return DeformableMirror.send(self, command)


def converts_type(self: Any, command: Any) -> Any:
    self.require_open()
    return DeformableMirror.send(self, np.array(command, dtype=float))


def halves(self: Any, command: Any) -> Any:
    return DeformableMirror.send(self, 0.5 * np.asarray(command))


def only_arrays(self: Any, command: Any) -> Any:
    if not isinstance(command, np.ndarray):
        raise CommandRejected(self.name, "give an array")
    return DeformableMirror.send(self, command)


def keeps_reference(self: Any, command: Any) -> Any:
    report = DeformableMirror.send(self, command)
    self._guard.last = command
    return report


def writable_report(self: Any, command: Any) -> Any:
    report = DeformableMirror.send(self, command)
    return replace(report, sent=report.sent.copy())


def counts_twice(self: Any, command: Any) -> Any:
    report = DeformableMirror.send(self, command)
    self.sent_count += 1
    return report


def on_another_clock(self: Any, command: Any) -> Any:
    return replace(DeformableMirror.send(self, command), sent_ns=time.time_ns())


def beyond_the_guard(self: Any) -> None:
    DeformableMirror._after_open(self)
    self._guard.obeys = lambda shape: True


def keeps_quiet(self: Any, command: Any) -> Any:
    report = DeformableMirror.send(self, command)
    return replace(report, guard=GuardReport())


def accepts_first(self: Any, command: Any) -> Any:
    safe, _ = self._checked()(command)
    self._guard.reset(self._guard.last)
    return DeformableMirror.send(self, safe)


def jumps_to_flat(self: Any) -> None:
    if (self.shape != self.flat).any() or not self.sent_count:
        DeformableMirror.send(self, self.flat)


def lazy_flatten(self: Any) -> None:
    if (self.shape != self.flat).any():
        DeformableMirror.flatten(self)


def any_flat(self: Any, command: Any) -> None:
    self._flat = np.asarray(command, dtype=float)


def leaks_on_failure(self: Any) -> None:
    self._before_close()
    self._close()
    self._is_open = False


def hides_the_cause(self: Any, *error: Any) -> None:
    self.close()


MIRRORS: list[Broken] = [
    ("no serial", RecordingMirror, "mirror_info_is_complete", {"info": info_of(serial="")}),
    (
        "too few places",
        RecordingMirror,
        "mirror_info_is_complete",
        {"info": info_of(positions_m=np.zeros((3, 2)))},
    ),
    ("x and y swapped", RecordingMirror, "mirror_info_is_complete", {}),
    ("stroke in microns", RecordingMirror, "mirror_info_is_complete", {"info": info_of(stroke_m=2.2)}),
    ("repairs NaN", RecordingMirror, "mirror_refuses_not_finite", {"send": repairs_nan}),
    ("names no index", RecordingMirror, "mirror_refuses_not_finite", {"send": names_no_index}),
    ("takes any shape", RecordingMirror, "mirror_refuses_wrong_shape", {"send": flattens_shape}),
    ("takes any type", RecordingMirror, "mirror_refuses_wrong_type", {"send": converts_type}),
    ("sends half", RecordingMirror, "mirror_sends_legal_commands_unchanged", {"send": halves}),
    ("no lists", RecordingMirror, "mirror_takes_any_real_array", {"send": only_arrays}),
    ("keeps a reference", RecordingMirror, "mirror_shares_no_memory", {"send": keeps_reference}),
    ("writable report", RecordingMirror, "mirror_shares_no_memory", {"send": writable_report}),
    ("counts twice", RecordingMirror, "mirror_counts", {"send": counts_twice}),
    ("another clock", RecordingMirror, "mirror_times_its_sends", {"send": on_another_clock}),
    ("no guard", RecordingMirror, "mirror_obeys_its_limits", {"send": unguarded}),
    ("knocks first", RecordingMirror, "mirror_obeys_its_limits", {"send": knocks_first}),
    ("guard switched off", RecordingMirror, "mirror_obeys_its_limits", {"_after_open": beyond_the_guard}),
    ("keeps quiet", RecordingMirror, "mirror_reports_clipping", {"send": keeps_quiet}),
    ("believes too early", RecordingMirror, "mirror_failed_transfer_keeps_shape", {"send": accepts_first}),
    ("lazy flatten", RecordingMirror, "mirror_flattens", {"flatten": lazy_flatten}),
    ("takes any flat", RecordingMirror, "mirror_flat_can_be_set", {"set_flat": any_flat}),
    ("jumps to flat", RecordingMirror, "mirror_ramps_to_flat", {"flatten": jumps_to_flat}),
    ("closes poked", RecordingMirror, "mirror_is_flat_when_closed", {"_before_close": lambda self: None}),
    ("stays open when lost", RecordingMirror, "mirror_closes_when_lost", {"close": leaks_on_failure}),
    ("hides the cause", RecordingMirror, "mirror_closes_when_lost", {"__exit__": hides_the_cause}),
]


class _Swapped(RecordingMirror):
    @property
    def info(self) -> DMInfo:
        info = super().info
        return replace(info, positions_m=info.positions_m[:, ::-1])


# --- cameras ----------------------------------------------------------------------------------


def checks_by_setting(self: Any, want: Any) -> Any:
    self._settings = SyntheticCamera._check(self, want)
    return self._settings


def says_yes(self: Any, want: Any) -> Any:
    return want


def drifts(self: Any, want: Any) -> Any:
    return replace(SyntheticCamera._check(self, want), gain_db=want.gain_db + 0.1)


def never_right(self: Any, want: Any) -> Any:
    answer = SyntheticCamera._check(self, want)
    return replace(answer, exposure_s=1e-4 if answer.exposure_s == 1e-3 else 1e-3)


def takes_all(self: Any, want: Any) -> Any:
    self.require_open()
    return want


def takes_all_and_sets(self: Any, want: Any) -> Any:
    self._settings = want
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


def one_buffer(frame_of: Any) -> Any:
    def _next_frame(self: Any, timeout_s: float) -> Any:
        frame = SyntheticCamera._next_frame(self, timeout_s)
        if getattr(self, "buffer", None) is None or self.buffer.shape != frame.data.shape:
            self.buffer = frame.data.copy()
        self.buffer[:] = frame.data
        view = self.buffer.view()
        return replace(frame, data=frozen(view))

    return _next_frame


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
    return 2 * round(1e9 / self._settings.frame_rate_hz)


def miscounts(self: Any) -> Any:
    return replace(Camera.status(self), lost=3)


CAMERAS: list[Broken] = [
    (
        "no serial",
        SyntheticCamera,
        "camera_info_is_complete",
        {"info": property(lambda self: replace(SyntheticCamera.info.fget(self), serial=""))},  # type: ignore[attr-defined]
    ),
    ("settings out of reach", SyntheticCamera, "camera_settings_are_achievable", {"_check": never_right}),
    ("check drifts", SyntheticCamera, "camera_check_is_a_fixed_point", {"_check": drifts}),
    ("check sets", SyntheticCamera, "camera_check_changes_nothing", {"_check": checks_by_setting}),
    ("any region", SyntheticCamera, "camera_refuses_regions_off_the_sensor", {"check": takes_all}),
    ("any settings", SyntheticCamera, "camera_refuses_meaningless_settings", {"check": takes_all}),
    ("configure lies", SyntheticCamera, "camera_configure_tells_the_truth", {"configure": lies}),
    ("region ignored", SyntheticCamera, "camera_configure_tells_the_truth", {"_configure": forgets_region}),
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
    ("one buffer", SyntheticCamera, "camera_frames_are_kept", {"_next_frame": one_buffer(None)}),
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
    ("gives None", SyntheticCamera, "camera_keeps_deadlines", {"_next_frame": gives_none}),
    ("waits for ever", SyntheticCamera, "camera_keeps_deadlines", {"_next_frame": waits_for_ever}),
]

# --- modulators and screens -------------------------------------------------------------------


def checks_by_moving(self: Any, want: Any) -> Any:
    self._modulation = QuantisedModulator._check(self, want)
    return self._modulation


def modulates_as_asked(self: Any, want: Any) -> Any:
    QuantisedModulator.modulate(self, want)
    return want


def forgets_the_rest(self: Any, **change: Any) -> Any:
    self.require_open()
    return SteadyScreen.set(self, **{"screen": 0, **change})


def answers_blindly(self: Any, **change: Any) -> Any:
    return replace(SteadyScreen.set(self, **change), speed_m_s=1.0)


def sticks(self: Any, want: Any) -> None:
    self._state = replace(want, screen=min(want.screen, 2))


def repairs_screen(self: Any, **change: Any) -> Any:
    try:
        return SteadyScreen.set(self, **change)
    except SettingRejected:
        return self._state


OTHERS: list[Broken] = [
    ("check moves", QuantisedModulator, "modulator_check_changes_nothing", {"_check": checks_by_moving}),
    ("any modulation", QuantisedModulator, "modulator_refuses_meaningless", {"check": takes_all}),
    ("modulate lies", QuantisedModulator, "modulator_tells_the_truth", {"modulate": modulates_as_asked}),
    ("does not park", QuantisedModulator, "modulator_parks", {"_park": lambda self: None}),
    (
        "closes moving",
        QuantisedModulator,
        "modulator_is_parked_when_closed",
        {"_before_close": lambda self: None},
    ),
    ("counts from one", SteadyScreen, "screen_state_makes_sense", {"n_screens": property(lambda self: 1)}),
    ("takes anything", SteadyScreen, "screen_refuses_meaningless", {"set": repairs_screen}),
    ("forgets the rest", SteadyScreen, "screen_set_keeps_the_rest", {"set": forgets_the_rest}),
    ("answers blindly", SteadyScreen, "screen_set_keeps_the_rest", {"set": answers_blindly}),
    ("sticks", SteadyScreen, "screen_reaches_every_screen", {"_set": sticks}),
]

BROKEN = [*GENERAL, *MIRRORS, *CAMERAS, *OTHERS]


@pytest.mark.parametrize(
    ("base", "expected", "defects"),
    [pytest.param(*case[1:], id=f"{case[1].__name__}: {case[0]}") for case in BROKEN],
)
def test_check_catches(base: type[Device], expected: str, defects: dict[str, Any]) -> None:
    broken = type("Broken", (base,), defects) if defects else _Swapped
    results = {result.check: result for result in run_checks(broken)}
    caught = results[f"check_{expected}"]
    assert caught.outcome == "failed", f"check_{expected} let it through; failed instead: " + str(
        [name for name, result in results.items() if result.outcome == "failed"]
    )
    assert len(caught.message) > 20, f"the message does not help: {caught.message!r}"


def test_every_check_is_tested() -> None:
    devices: tuple[Device, ...] = (RecordingMirror(), SyntheticCamera(), QuantisedModulator(), SteadyScreen())
    shipped = {check.__name__ for device in devices for check in checks_for(device)}
    assert shipped == {f"check_{expected}" for _, _, expected, _ in BROKEN}
