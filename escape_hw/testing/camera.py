"""Contract checks of cameras: settings, acquisition, frames and time-outs."""

from __future__ import annotations

import math
import statistics
import time
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np

from escape_hw.api.camera import Camera, CameraInfo, CameraSettings, Frame, FrameStatus, Region
from escape_hw.errors import FrameTimeout, SettingRejected
from escape_hw.testing.checks import NORMAL, READS, assert_identified, assert_refused, check

#: Longest duration of a call with a much shorter time-out, wall-clock seconds.
_MAX_CALL_S = 10.0
#: Number of calls that exhaust the buffer of any driver.
_CALLS = 200


def generous_timeout_s(camera: Camera) -> float:
    """A time-out that a working camera never reaches."""
    now = camera.settings
    return 2.0 + 20 * (now.exposure_s + 1 / now.frame_rate_hz)


def _frames(camera: Camera, n: int) -> list[Frame]:
    return [camera.next_frame(generous_timeout_s(camera)) for _ in range(n)]


@check(Camera, READS)
def check_camera_frames_are_well_formed(camera: Camera) -> None:
    """Frames are read-only uint16 of the shape of the region, within the bit depth."""
    region, top = camera.settings.region, camera.info.full_scale
    for frame in _frames(camera, 3):
        data = frame.data
        assert isinstance(data, np.ndarray), f"data is {type(data).__name__}, not an array"
        assert data.dtype == np.uint16, f"data has type {data.dtype}, not uint16"
        assert data.shape == (region.height, region.width), (
            f"data has shape {data.shape}; the region has {region.height} rows of {region.width}"
        )
        assert not data.flags.writeable, "data is writable; several readers share it"
        assert int(data.max()) <= top, f"a pixel has {data.max()} counts; full scale is {top}"
        saturated = int(np.count_nonzero(data == top))
        assert frame.n_saturated == saturated, (
            f"n_saturated is {frame.n_saturated}, but {saturated} pixels are at full scale"
        )


@check(Camera, READS)
def check_camera_frames_are_not_overwritten(camera: Camera) -> None:
    """Later frames do not overwrite the array of an earlier one."""
    first = camera.next_frame(generous_timeout_s(camera))
    before = first.data.copy()
    for later in _frames(camera, 8):
        assert not np.shares_memory(first.data, later.data), "two frames share one buffer"
    assert np.array_equal(first.data, before), "later frames changed an earlier one"


@check(Camera, READS)
def check_camera_index_and_time_rise(camera: Camera) -> None:
    """Index and times increase from frame to frame; a frame arrives after its exposure."""
    frames = _frames(camera, 10)
    now = camera.now_ns()
    for one, next_one in pairwise(frames):
        assert next_one.index > one.index, f"the index went from {one.index} to {next_one.index}"
        assert next_one.exposed_ns > one.exposed_ns, "exposed_ns did not increase"
        assert next_one.arrived_ns >= one.arrived_ns, "arrived_ns decreased"
    for frame in frames:
        assert isinstance(frame.index, int), f"index is {type(frame.index).__name__}, not int"
        assert frame.exposed_ns <= frame.arrived_ns, "a frame arrived before its exposure had ended"
        assert frame.arrived_ns <= now, "arrived_ns is in the future of the camera clock"


@check(Camera, READS)
def check_camera_rate_is_as_stated(camera: Camera) -> None:
    """The rate from ``exposed_ns`` is ``settings.frame_rate_hz`` within 10 %."""
    frames = _frames(camera, 20)
    periods = [(b.exposed_ns - a.exposed_ns) / (b.index - a.index) for a, b in pairwise(frames)]
    rate, stated = 1e9 / statistics.median(periods), camera.settings.frame_rate_hz
    assert abs(rate / stated - 1) < 0.1, f"settings has {stated:.6g} Hz, the frames arrive at {rate:.6g} Hz"


@check(Camera, READS)
def check_camera_counts_add_up(camera: Camera) -> None:
    """Delivered and lost frames together account for every index."""
    camera.start()
    frames = _frames(camera, 10)
    status = camera.status()
    assert status.delivered == 10, f"ten frames were delivered, status says {status}"
    span = frames[-1].index - frames[0].index + 1
    assert status.delivered + status.lost == span, f"{status} does not account for {span} indices"
    assert status.timeouts == 0, f"{status}, but no call timed out"


@check(Camera, READS)
def check_camera_refuses_timeouts(camera: Camera) -> None:
    """A time-out that is not positive and finite is rejected."""
    for timeout_s in (0.0, -1.0, math.nan, math.inf):
        what = f"next_frame(timeout_s={timeout_s})"
        assert_refused(camera, SettingRejected, what, camera.next_frame, timeout_s)


@check(Camera, NORMAL)
def check_camera_raises_timeout(camera: Camera) -> None:
    """``next_frame`` raises and counts ``FrameTimeout``, and works afterwards."""
    original = camera.settings
    try:
        _slow_down(camera)
        _assert_times_out(camera)
    finally:
        camera.configure(original)


@check(Camera, READS)
def check_camera_polls_without_waiting(camera: Camera) -> None:
    """``poll`` returns a frame or ``None`` without waiting, and counts no time-out."""
    camera.next_frame(generous_timeout_s(camera))
    delivered, taken_ns = 1, []
    for _ in range(11):
        began = camera.now_ns()
        frame = camera.poll()
        taken_ns.append(camera.now_ns() - began)
        assert frame is None or isinstance(frame, Frame), f"poll() returned {type(frame).__name__}"
        delivered += frame is not None
    status = camera.status()
    assert status.timeouts == 0, f"{status}: poll() must not count a time-out"
    assert status.delivered == delivered, f"{status}, but {delivered} frames were delivered"
    usual_s, period_s = statistics.median(taken_ns) * 1e-9, 1 / camera.settings.frame_rate_hz
    assert usual_s < 0.5 * period_s, f"poll() took {usual_s:.3g} s; it must not wait for a frame"


def _slow_down(camera: Camera) -> None:
    try:
        camera.configure(replace(camera.settings, frame_rate_hz=min(20.0, camera.settings.frame_rate_hz)))
    except SettingRejected:
        # Keep the rate of a camera that cannot run so slowly.
        return


def _assert_times_out(camera: Camera) -> None:
    short_timeout_s = 1e-3 / camera.settings.frame_rate_hz
    last = camera.next_frame(generous_timeout_s(camera)).index
    timeouts = 0
    for _ in range(_CALLS):
        began = time.monotonic()
        try:
            frame = camera.next_frame(short_timeout_s)
            last = frame.index
        except FrameTimeout as timeout:
            timeouts += 1
            assert camera.name in str(timeout), f"the time-out does not name the camera: {timeout}"
        except Exception as other:
            raise AssertionError(f"expected FrameTimeout, got {type(other).__name__}: {other}") from other
        took = time.monotonic() - began
        assert took < _MAX_CALL_S, f"next_frame({short_timeout_s:.3g} s) took {took:.1f} s"
        if timeouts >= 3:
            break
    assert timeouts, (
        f"{_CALLS} calls with a thousandth of the frame period ({short_timeout_s:.3g} s) never timed out"
    )
    counted = camera.status().timeouts
    assert counted == timeouts, f"status says {counted} time-outs; there were {timeouts}"
    after = camera.next_frame(generous_timeout_s(camera)).index
    assert after > last, f"after a time-out the index went from {last} to {after}"


@check(Camera, READS)
def check_camera_info_is_complete(camera: Camera) -> None:
    """Identity and fixed properties are complete and valid."""
    info = camera.info
    assert_identified(info, CameraInfo)
    assert info.serial, "info.serial is empty; products need it"
    assert 1 <= info.bit_depth <= 16, f"info.bit_depth is {info.bit_depth}; frames are uint16"
    assert len(info.sensor_shape) == 2, f"info.sensor_shape is {info.sensor_shape}, not (rows, columns)"
    assert min(info.sensor_shape) >= 1, f"info.sensor_shape is {info.sensor_shape}"


@check(Camera, READS)
def check_camera_settings_are_achievable(camera: Camera) -> None:
    """``check`` returns the present settings unchanged."""
    settings = camera.settings
    assert isinstance(settings, CameraSettings), f"settings is {type(settings).__name__}"
    answer = camera.check(settings)
    assert answer == settings, f"the settings are {settings}, but check() returns {answer}"


@check(Camera, READS)
def check_camera_check_is_a_fixed_point(camera: Camera) -> None:
    """The result of ``check`` is achievable: a second ``check`` returns it unchanged."""
    for want in _trial_settings(camera):
        answer = camera.check(want)
        again = camera.check(answer)
        assert again == answer, f"check() made {answer} of {want}, and then {again} of its own answer"


@check(Camera, READS)
def check_camera_check_changes_nothing(camera: Camera) -> None:
    """``check`` changes neither settings nor acquisition."""
    for running in (False, True):
        if running:
            camera.next_frame(generous_timeout_s(camera))
        before = camera.settings, camera.is_running, camera.status()
        for want in _trial_settings(camera):
            camera.check(want)
            after = camera.settings, camera.is_running, camera.status()
            assert after == before, f"check({want}) changed the camera from {before} to {after}"


@check(Camera, READS)
def check_camera_regions_do_not_grow(camera: Camera) -> None:
    """The nearest region lies within the requested one; a region that contains none is rejected."""
    now = camera.settings
    for inset in (1, 2, 3, 5, min(now.region.width, now.region.height) - 1):
        sides = now.region.width - inset, now.region.height - inset
        if min(sides) < 1:
            continue
        want = Region(now.region.x + inset, now.region.y + inset, *sides)
        try:
            got = camera.check(replace(now, region=want)).region
        except SettingRejected:
            # It contains none of the regions of this camera.
            continue
        inside_x = want.x <= got.x and got.x + got.width <= want.x + want.width
        inside_y = want.y <= got.y and got.y + got.height <= want.y + want.height
        assert inside_x, f"check() made {got} of {want}, which does not contain its columns"
        assert inside_y, f"check() made {got} of {want}, which does not contain its rows"


@check(Camera, READS)
def check_camera_refuses_regions_off_the_sensor(camera: Camera) -> None:
    """``check`` and ``configure`` reject a region outside the sensor."""
    before = camera.settings
    rows, columns = camera.info.sensor_shape
    wrong = {
        "left of the sensor": Region(-8, 0, 8, 8),
        "above the sensor": Region(0, -8, 8, 8),
        "too wide": Region(0, 0, columns + 8, rows),
        "too high": Region(0, 0, columns, rows + 8),
        "over the edge": Region(columns - 1, rows - 1, 16, 16),
        "without width": Region(0, 0, 0, rows),
        "of negative height": Region(0, 0, columns, -1),
        "in fractions": Region(0, 0, columns / 2, rows / 2),  # type: ignore[arg-type]
    }
    for what, region in wrong.items():
        _assert_settings_unchanged(camera, before, replace(before, region=region), f"a region {what}")


@check(Camera, READS)
def check_camera_refuses_meaningless_settings(camera: Camera) -> None:
    """Exposure, rate and gain that are not valid numbers are rejected."""
    before = camera.settings
    not_positive, not_finite = (0.0, -1.0), (math.nan, math.inf)
    wrong = [("exposure_s", value) for value in (*not_positive, *not_finite)]
    wrong += [("frame_rate_hz", value) for value in (*not_positive, *not_finite)]
    wrong += [("gain_db", value) for value in not_finite]
    for name, value in wrong:
        change: dict[str, Any] = {name: value}
        _assert_settings_unchanged(camera, before, replace(before, **change), f"{name} = {value}")


def _assert_settings_unchanged(
    camera: Camera, before: CameraSettings, want: CameraSettings, what: str
) -> None:
    for verb in (camera.check, camera.configure):
        assert_refused(camera, SettingRejected, f"{verb.__name__}() with {what}", verb, want)
        assert camera.settings == before, f"{what}: rejected, but the settings changed"


@check(Camera, NORMAL)
def check_camera_configure_reports_actual_settings(camera: Camera) -> None:
    """The result of ``configure`` agrees with ``settings`` and with the frames."""
    original = camera.settings
    try:
        for want in _trial_settings(camera):
            answer = camera.configure(want)
            now = camera.settings
            assert answer == now, f"configure() returned {answer}, but settings is {now}"
            checked = camera.check(want)
            assert answer.region == checked.region, (
                f"check() returned {checked.region}, configure() {answer.region}"
            )
            shape = camera.next_frame(generous_timeout_s(camera)).data.shape
            stated = (now.region.height, now.region.width)
            assert shape == stated, f"settings has {stated}, but frames have shape {shape}"
    finally:
        camera.configure(original)


@check(Camera, NORMAL)
def check_camera_configures_while_running(camera: Camera) -> None:
    """``configure`` preserves whether the camera acquires."""
    original = camera.settings
    try:
        camera.configure(_half_region(camera))
        assert not camera.is_running, "configure() started acquisition"
        camera.start()
        camera.next_frame(generous_timeout_s(camera))
        camera.configure(original)
        assert camera.is_running, "acquisition stopped after configure()"
        camera.next_frame(generous_timeout_s(camera))
    finally:
        camera.configure(original)


@check(Camera, READS)
def check_camera_start_and_stop_repeat(camera: Camera) -> None:
    """``start`` and ``stop`` may be repeated; ``next_frame`` starts acquisition."""
    camera.stop()
    assert not camera.is_running, "running before start()"
    for _ in range(2):
        camera.start()
        camera.start()
        assert camera.is_running, "not running after start()"
        camera.next_frame(generous_timeout_s(camera))
        camera.stop()
        camera.stop()
        assert not camera.is_running, "still running after stop()"
    camera.next_frame(generous_timeout_s(camera))
    assert camera.is_running, "next_frame() did not start acquisition"


@check(Camera, READS)
def check_camera_restart_resets_counters(camera: Camera) -> None:
    """``start`` resets the counters unless the camera is running."""
    for _ in range(3):
        camera.next_frame(generous_timeout_s(camera))
    camera.start()
    assert camera.status().delivered == 3, f"{camera.status()} after three frames and a second start()"
    camera.stop()
    assert camera.status().delivered == 3, "stop() lost the counters"
    camera.start()
    assert camera.status() == FrameStatus(), f"{camera.status()} just after a new start()"


@check(Camera, READS)
def check_camera_closes_while_running(camera: Camera) -> None:
    """``close`` stops acquisition, and the camera can be used again."""
    camera.next_frame(generous_timeout_s(camera))
    camera.close()
    assert not camera.is_open, "still open after close()"
    assert not camera.is_running, "still running after close()"
    camera.open()
    assert not camera.is_running, "running just after open()"
    camera.next_frame(generous_timeout_s(camera))


def _half_region(camera: Camera) -> CameraSettings:
    now = camera.settings
    region = now.region
    half = Region(region.x, region.y, max(1, region.width // 2), max(1, region.height // 2))
    return replace(now, region=half)


def _trial_settings(camera: Camera) -> list[CameraSettings]:
    """Valid settings, most of which are not exactly achievable."""
    now = camera.settings
    longer = replace(now, exposure_s=now.exposure_s * 1.0137, frame_rate_hz=now.frame_rate_hz * 0.7731)
    return [now, _half_region(camera), longer]
