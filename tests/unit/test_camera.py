"""Cameras: checked settings, deadlines, counters and closing."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from escape_hw.api.camera import CameraInfo, CameraSettings, Frame, FrameStatus, Region
from escape_hw.errors import DeviceError, DeviceLost, FrameTimeout, NotOpen, SettingRejected
from escape_hw.testing.reference_devices import SyntheticCamera


class Scripted(SyntheticCamera):
    """A camera that delivers a script: indices, errors to raise, or anything else as it is."""

    def __init__(self, *script: Any) -> None:
        super().__init__("wfs")
        self.script = list(script)
        self.log: list[str] = []

    def _next_frame(self, timeout_s: float) -> Frame:
        step = self.script.pop(0)
        if isinstance(step, Exception):
            raise step
        if not isinstance(step, int):
            return step  # type: ignore[no-any-return]
        return replace(super()._next_frame(1e6), index=step)

    def _start(self) -> None:
        self.log.append("start")
        super()._start()

    def _stop(self) -> None:
        self.log.append("stop")

    def _close(self) -> None:
        self.log.append("close")


def test_counters_state_delivered_lost_and_timed_out() -> None:
    timeout = FrameTimeout("wfs", "nothing")
    with Scripted(5, 6, 9, timeout, 10, timeout) as camera:
        for _ in range(3):
            camera.next_frame()
        for _ in range(2):
            with pytest.raises(FrameTimeout):
                camera.next_frame()
            if camera.script:
                camera.next_frame()
        assert camera.status() == FrameStatus(delivered=4, lost=2, timeouts=2)
        camera.stop()
        camera.start()
        assert camera.status() == FrameStatus()


@pytest.mark.parametrize("second", [7, 3])
def test_an_index_that_does_not_rise_is_an_error_and_not_counted(second: int) -> None:
    with Scripted(7, second, 8) as camera:
        camera.next_frame()
        with pytest.raises(DeviceError, match=f"wfs: frame index went from 7 to {second}"):
            camera.next_frame()
        camera.next_frame()
        assert camera.status() == FrameStatus(delivered=2)


def test_a_lost_camera_is_reported_and_closes() -> None:
    camera = Scripted(1, DeviceLost("wfs", "cable out"))
    with camera:
        camera.next_frame()
        with pytest.raises(DeviceLost, match="wfs: cable out"):
            camera.next_frame()
    assert camera.log == ["start", "stop", "close"]
    assert not camera.is_running


def test_a_failing_stop_still_closes() -> None:
    class Stubborn(Scripted):
        def _stop(self) -> None:
            raise DeviceError(self.name, "will not stop")

    camera = Stubborn(1)
    camera.open()
    camera.next_frame()
    with pytest.raises(DeviceError, match="will not stop"):
        camera.close()
    assert camera.log == ["start", "close"]
    assert not camera.is_open
    assert not camera.is_running


def test_a_failing_start_leaves_it_stopped() -> None:
    class Stuck(Scripted):
        def _start(self) -> None:
            raise DeviceError(self.name, "no trigger")

    with Stuck(1) as camera:
        for start in (camera.start, camera.next_frame):
            with pytest.raises(DeviceError, match="no trigger"):
                start()
            assert not camera.is_running


def test_configure_stops_and_restarts_around_the_change() -> None:
    with Scripted(1) as camera:
        camera.next_frame()
        camera.configure(replace(camera.settings, frame_rate_hz=100.0))
        assert camera.log == ["start", "stop", "start"]
        assert camera.is_running
        camera.stop()
        camera.configure(replace(camera.settings, frame_rate_hz=200.0))
        assert camera.log == ["start", "stop", "start", "stop"]
        assert camera.settings.frame_rate_hz == 200.0


def test_a_refused_configuration_does_not_disturb_acquisition() -> None:
    with Scripted(1, 2) as camera:
        camera.next_frame()
        with pytest.raises(SettingRejected):
            camera.configure(replace(camera.settings, exposure_s=math.nan))
        assert camera.log == ["start"]
        assert camera.status().delivered == 1


def test_configure_answers_with_what_is_read_back() -> None:
    class Rounding(SyntheticCamera):
        def _configure(self, settings: CameraSettings) -> None:
            self._settings = replace(settings, gain_db=3.0)

    with Rounding() as camera:
        assert camera.configure(replace(camera.settings, gain_db=2.9)).gain_db == 3.0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"region": Region(60, 0, 8, 8)}, "64 x 48 pixels"),
        ({"region": Region(0, 0, 8, 0)}, "does not lie on the sensor"),
        ({"region": Region(0.0, 0, 8, 8)}, "whole pixels"),  # type: ignore[arg-type]
        ({"exposure_s": 0.0}, "exposure_s is 0.0; it must be positive"),
        ({"exposure_s": math.inf}, "exposure_s is inf"),
        ({"frame_rate_hz": math.nan}, "frame_rate_hz is nan"),
        ({"gain_db": math.nan}, "gain_db is nan"),
    ],
)
def test_settings_that_mean_nothing_never_reach_the_driver(change: dict[str, Any], words: str) -> None:
    class Driver(SyntheticCamera):
        def _check(self, want: CameraSettings) -> CameraSettings:
            raise AssertionError("the driver was asked")

    with Driver("wfs") as camera, pytest.raises(SettingRejected, match=words) as caught:
        camera.check(replace(camera.settings, **change))
    assert str(caught.value).startswith("wfs: ")


def test_whole_pixels_of_numpy_are_whole_pixels() -> None:
    with SyntheticCamera() as camera:
        region = Region(*(np.int64(v) for v in (8, 4, 32, 24)))  # type: ignore[arg-type]
        assert camera.check(replace(camera.settings, region=region)).region == camera.settings.region


@pytest.mark.parametrize("timeout_s", [0.0, -1.0, math.nan, math.inf])
def test_timeouts_are_positive_and_finite(timeout_s: float) -> None:
    with SyntheticCamera() as camera:
        with pytest.raises(SettingRejected, match="timeout_s is"):
            camera.next_frame(timeout_s)
        assert not camera.is_running


def test_poll_gives_what_is_there_and_counts_it() -> None:
    timeout = FrameTimeout("wfs", "nothing")
    with Scripted(4, timeout, 7) as camera:
        polled = [camera.poll() for _ in range(3)]
        assert [frame.index if frame else None for frame in polled] == [4, None, 7]
        assert camera.status() == FrameStatus(delivered=2, lost=2)


def test_nothing_works_while_closed_and_stop_does_no_harm() -> None:
    camera = SyntheticCamera("wfs")
    camera.stop()
    settings = camera.settings
    for use in (
        camera.start,
        camera.next_frame,
        lambda: camera.check(settings),
        lambda: camera.configure(settings),
    ):
        with pytest.raises(NotOpen, match="wfs: not open"):
            use()


@pytest.mark.parametrize(("bits", "top"), [(1, 1), (8, 255), (10, 1023), (16, 65535)])
def test_full_scale_follows_the_bit_depth(bits: int, top: int) -> None:
    assert CameraInfo("m", "s", (4, 4), bits, True).full_scale == top
