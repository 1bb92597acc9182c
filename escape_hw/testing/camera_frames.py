"""What a camera promises about the frames it delivers, and when it has none."""

from __future__ import annotations

import math
import statistics
import time
from dataclasses import replace
from itertools import pairwise

import numpy as np

from escape_hw.api.camera import Camera
from escape_hw.api.frames import Frame
from escape_hw.errors import FrameTimeout, SettingRejected
from escape_hw.testing.checks import NORMAL, READS, Check, Factory, check, opened, refused

#: A call with a time-out far below this must be back within it, in wall-clock seconds.
_HANGS_S = 10.0
#: Calls that drain whatever a driver has buffered.
_CALLS = 200


def patience_s(camera: Camera) -> float:
    """Give a time-out that a healthy camera never needs."""
    now = camera.settings
    return 2.0 + 20 * (now.exposure_s + 1 / now.frame_rate_hz)


def _frames(camera: Camera, n: int) -> list[Frame]:
    return [camera.next_frame(patience_s(camera)) for _ in range(n)]


@check(READS)
def check_camera_frames_are_well_formed(factory: Factory) -> None:
    """Frames are read-only uint16 of the region's shape, within the bit depth, and timed."""
    with opened(factory) as camera:
        region, top = camera.settings.region, camera.info.full_scale
        for frame in _frames(camera, 3):
            data = frame.data
            assert isinstance(data, np.ndarray), f"data is {type(data).__name__}, not an array"
            assert data.dtype == np.uint16, f"data has type {data.dtype}, not uint16"
            assert data.shape == (region.height, region.width), (
                f"data has shape {data.shape}; the region is {region.height} rows of {region.width}"
            )
            assert not data.flags.writeable, "data can be written to; several readers share it"
            assert int(data.max()) <= top, f"a pixel has {data.max()} counts; the scale ends at {top}"
            saturated = int(np.count_nonzero(data == top))
            assert frame.n_saturated == saturated, (
                f"n_saturated is {frame.n_saturated}, but {saturated} pixels are at the top of the scale"
            )


@check(READS)
def check_camera_frames_are_kept(factory: Factory) -> None:
    """Later frames do not overwrite the array of an earlier one."""
    with opened(factory) as camera:
        first = camera.next_frame(patience_s(camera))
        before = first.data.copy()
        for later in _frames(camera, 8):
            assert not np.shares_memory(first.data, later.data), "two frames share one buffer"
        assert np.array_equal(first.data, before), "a frame changed after later ones had come"


@check(READS)
def check_camera_index_and_time_rise(factory: Factory) -> None:
    """Index and times rise from frame to frame; a frame arrives after it was exposed."""
    with opened(factory) as camera:
        frames = _frames(camera, 10)
        now = camera.now_ns()
        for one, next_one in pairwise(frames):
            assert next_one.index > one.index, f"the index went from {one.index} to {next_one.index}"
            assert next_one.exposed_ns > one.exposed_ns, "exposed_ns did not rise"
            assert next_one.arrived_ns >= one.arrived_ns, "arrived_ns fell"
        for frame in frames:
            assert isinstance(frame.index, int), f"index is {type(frame.index).__name__}, not int"
            assert frame.exposed_ns <= frame.arrived_ns, "a frame arrived before its exposure had ended"
            assert frame.arrived_ns <= now, "a frame is said to arrive in the future of the camera's clock"


@check(READS)
def check_camera_rate_is_as_stated(factory: Factory) -> None:
    """Frames come at ``settings.frame_rate_hz``, by their own times (10 % tolerance)."""
    with opened(factory) as camera:
        frames = _frames(camera, 20)
        periods = [(b.exposed_ns - a.exposed_ns) / (b.index - a.index) for a, b in pairwise(frames)]
        rate, stated = 1e9 / statistics.median(periods), camera.settings.frame_rate_hz
        assert abs(rate / stated - 1) < 0.1, (
            f"settings says {stated:.6g} Hz, the frames come at {rate:.6g} Hz"
        )


@check(READS)
def check_camera_counts_add_up(factory: Factory) -> None:
    """Delivered and lost frames together account for every index."""
    with opened(factory) as camera:
        camera.start()
        frames = _frames(camera, 10)
        status = camera.status()
        assert status.delivered == 10, f"ten frames were delivered, status says {status}"
        span = frames[-1].index - frames[0].index + 1
        assert status.delivered + status.lost == span, f"{status} does not account for {span} indices"
        assert status.timeouts == 0, f"{status}, but no call timed out"


@check(READS)
def check_camera_refuses_timeouts(factory: Factory) -> None:
    """A time-out that is zero, negative, not a number or endless is refused."""
    with opened(factory) as camera:
        for timeout_s in (0.0, -1.0, math.nan, math.inf):
            what = f"next_frame(timeout_s={timeout_s})"
            refused(camera, SettingRejected, what, camera.next_frame, timeout_s)


@check(NORMAL)
def check_camera_keeps_deadlines(factory: Factory) -> None:
    """With no frame in time ``next_frame`` raises ``FrameTimeout``, counts it, and goes on after it."""
    with opened(factory) as camera:
        original = camera.settings
        try:
            _slow_down(camera)
            _must_time_out(camera)
        finally:
            camera.configure(original)


@check(READS)
def check_camera_polls_without_waiting(factory: Factory) -> None:
    """``poll`` gives what is there or ``None``, takes no time, and counts no time-out."""
    with opened(factory) as camera:
        camera.next_frame(patience_s(camera))
        delivered, taken_ns = 1, []
        for _ in range(11):
            began = camera.now_ns()
            frame = camera.poll()
            taken_ns.append(camera.now_ns() - began)
            assert frame is None or isinstance(frame, Frame), f"poll() gave {type(frame).__name__}"
            delivered += frame is not None
        status = camera.status()
        assert status.timeouts == 0, f"{status}: an empty poll() is no time-out"
        assert status.delivered == delivered, f"{status}, but {delivered} frames were delivered"
        usual_s, period_s = statistics.median(taken_ns) * 1e-9, 1 / camera.settings.frame_rate_hz
        assert usual_s < 0.5 * period_s, f"poll() took {usual_s:.3g} s; it must not wait for a frame"


def _slow_down(camera: Camera) -> None:
    try:
        camera.configure(replace(camera.settings, frame_rate_hz=min(20.0, camera.settings.frame_rate_hz)))
    except SettingRejected:
        # It cannot go so slowly; then its own rate has to do.
        return


def _must_time_out(camera: Camera) -> None:
    hurry = 1e-3 / camera.settings.frame_rate_hz
    last = camera.next_frame(patience_s(camera)).index
    timeouts = 0
    for _ in range(_CALLS):
        began = time.monotonic()
        try:
            frame = camera.next_frame(hurry)
            last = frame.index
        except FrameTimeout as timeout:
            timeouts += 1
            assert camera.name in str(timeout), f"the time-out does not name the camera: {timeout}"
        except Exception as other:
            raise AssertionError(f"FrameTimeout was due, {type(other).__name__} came: {other}") from other
        took = time.monotonic() - began
        assert took < _HANGS_S, f"next_frame({hurry:.3g} s) took {took:.1f} s"
        if timeouts >= 3:
            break
    assert timeouts, f"{_CALLS} calls with a thousandth of the frame period ({hurry:.3g} s) never timed out"
    counted = camera.status().timeouts
    assert counted == timeouts, f"status says {counted} time-outs; there were {timeouts}"
    after = camera.next_frame(patience_s(camera)).index
    assert after > last, f"after a time-out the index went from {last} to {after}"


FRAMES: tuple[Check, ...] = (
    check_camera_frames_are_well_formed,
    check_camera_frames_are_kept,
    check_camera_index_and_time_rise,
    check_camera_rate_is_as_stated,
    check_camera_counts_add_up,
    check_camera_refuses_timeouts,
    check_camera_keeps_deadlines,
    check_camera_polls_without_waiting,
)
