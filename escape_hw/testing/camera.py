"""What a camera promises about its settings and its acquisition."""

from __future__ import annotations

import math
from dataclasses import replace

from escape_hw.api.camera import Camera
from escape_hw.api.frames import CameraInfo, CameraSettings, FrameStatus, Region
from escape_hw.errors import SettingRejected
from escape_hw.testing.camera_frames import FRAMES, patience_s
from escape_hw.testing.checks import NORMAL, READS, Check, Factory, check, opened, refused, up_to
from escape_hw.testing.common import COMMON


@check(READS)
def check_camera_info_is_complete(factory: Factory) -> None:
    """Identity and fixed properties are there and make sense."""
    with opened(factory) as camera:
        info = camera.info
        assert isinstance(info, CameraInfo), f"info is {type(info).__name__}, not CameraInfo"
        assert info.model, "info.model is empty"
        assert info.serial, "info.serial is empty; products could not say which camera they are from"
        assert isinstance(info.simulated, bool), f"info.simulated is {info.simulated!r}, not a bool"
        assert 1 <= info.bit_depth <= 16, f"info.bit_depth is {info.bit_depth}; frames are uint16"
        assert len(info.sensor_shape) == 2, f"info.sensor_shape is {info.sensor_shape}, not (rows, columns)"
        assert min(info.sensor_shape) >= 1, f"info.sensor_shape is {info.sensor_shape}"


@check(READS)
def check_camera_settings_are_achievable(factory: Factory) -> None:
    """The settings in force are settings that ``check`` answers with itself."""
    with opened(factory) as camera:
        settings = camera.settings
        assert isinstance(settings, CameraSettings), f"settings is {type(settings).__name__}"
        answer = camera.check(settings)
        assert answer == settings, f"settings in force are {settings}, but check() makes {answer} of them"


@check(READS)
def check_camera_check_is_a_fixed_point(factory: Factory) -> None:
    """What ``check`` answers with is achievable: checked again, it stays."""
    with opened(factory) as camera:
        for want in _wishes(camera):
            answer = camera.check(want)
            again = camera.check(answer)
            assert again == answer, f"check() made {answer} of {want}, and then {again} of its own answer"


@check(READS)
def check_camera_check_changes_nothing(factory: Factory) -> None:
    """``check`` changes no setting and does not disturb acquisition."""
    with opened(factory) as camera:
        for running in (False, True):
            if running:
                camera.next_frame(patience_s(camera))
            before = camera.settings, camera.is_running, camera.status()
            for want in _wishes(camera):
                camera.check(want)
                after = camera.settings, camera.is_running, camera.status()
                assert after == before, f"check({want}) changed the camera from {before} to {after}"


@check(READS)
def check_camera_refuses_regions_off_the_sensor(factory: Factory) -> None:
    """A region that does not lie on the sensor is refused, by ``check`` and by ``configure``."""
    with opened(factory) as camera:
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
            "in fractions": Region(0, 0, columns / 2, rows / 2),
        }
        for what, region in wrong.items():
            _stays(camera, before, replace(before, region=region), f"a region {what}")


@check(READS)
def check_camera_refuses_meaningless_settings(factory: Factory) -> None:
    """Exposure, rate and gain that mean nothing are refused."""
    with opened(factory) as camera:
        before = camera.settings
        for name in ("exposure_s", "frame_rate_hz"):
            for value in (0.0, -1.0, math.nan, math.inf):
                _stays(camera, before, replace(before, **{name: value}), f"{name} = {value}")
        for value in (math.nan, math.inf):
            _stays(camera, before, replace(before, gain_db=value), f"gain_db = {value}")


def _stays(camera: Camera, before: CameraSettings, want: CameraSettings, what: str) -> None:
    for verb in (camera.check, camera.configure):
        refused(camera, SettingRejected, f"{verb.__name__}() with {what}", verb, want)
        assert camera.settings == before, f"{what}: refused, but the settings changed"


@check(NORMAL)
def check_camera_configure_tells_the_truth(factory: Factory) -> None:
    """``configure`` answers with what is in force: ``settings`` and the frames bear it out."""
    with opened(factory) as camera:
        original = camera.settings
        try:
            for want in _wishes(camera):
                answer = camera.configure(want)
                now = camera.settings
                assert answer == now, f"configure() answered {answer}, but settings says {now}"
                foreseen = camera.check(want)
                assert answer.region == foreseen.region, (
                    f"check() foresaw {foreseen.region}, configure() made {answer.region}"
                )
                shape = camera.next_frame(patience_s(camera)).data.shape
                stated = (now.region.height, now.region.width)
                assert shape == stated, f"settings says {stated}, but frames come as {shape}"
        finally:
            camera.configure(original)


@check(NORMAL)
def check_camera_configures_while_running(factory: Factory) -> None:
    """Acquisition goes on after ``configure`` if it ran before, and stays off if it did not."""
    with opened(factory) as camera:
        original = camera.settings
        try:
            camera.configure(_smaller(camera))
            assert not camera.is_running, "configure() started acquisition"
            camera.start()
            camera.next_frame(patience_s(camera))
            camera.configure(original)
            assert camera.is_running, "acquisition did not go on after configure()"
            camera.next_frame(patience_s(camera))
        finally:
            camera.configure(original)


@check(READS)
def check_camera_start_and_stop_repeat(factory: Factory) -> None:
    """``start`` and ``stop`` may be called any number of times; the first frame starts too."""
    with opened(factory) as camera:
        camera.stop()
        assert not camera.is_running, "running before start()"
        for _ in range(2):
            camera.start()
            camera.start()
            assert camera.is_running, "not running after start()"
            camera.next_frame(patience_s(camera))
            camera.stop()
            camera.stop()
            assert not camera.is_running, "still running after stop()"
        camera.next_frame(patience_s(camera))
        assert camera.is_running, "next_frame() did not start acquisition"


@check(READS)
def check_camera_restart_resets_counters(factory: Factory) -> None:
    """The counters count from ``start``; ``start`` of a running camera resets nothing."""
    with opened(factory) as camera:
        for _ in range(3):
            camera.next_frame(patience_s(camera))
        camera.start()
        assert camera.status().delivered == 3, f"{camera.status()} after three frames and a second start()"
        camera.stop()
        assert camera.status().delivered == 3, "stop() lost the counters"
        camera.start()
        assert camera.status() == FrameStatus(), f"{camera.status()} just after a new start()"


@check(READS)
def check_camera_closes_while_running(factory: Factory) -> None:
    """``close`` stops acquisition first, and the camera can be opened and used again."""
    with opened(factory) as camera:
        camera.next_frame(patience_s(camera))
        camera.close()
        assert not camera.is_open, "still open after close()"
        assert not camera.is_running, "still running after close()"
        camera.open()
        assert not camera.is_running, "running just after open()"
        camera.next_frame(patience_s(camera))


def _smaller(camera: Camera) -> CameraSettings:
    now = camera.settings
    region = now.region
    half = Region(region.x, region.y, max(1, region.width // 2), max(1, region.height // 2))
    return replace(now, region=half)


def _wishes(camera: Camera) -> list[CameraSettings]:
    """Settings that any camera can come near to, none of them likely to be exactly achievable."""
    now = camera.settings
    longer = replace(now, exposure_s=now.exposure_s * 1.0137, frame_rate_hz=now.frame_rate_hz * 0.7731)
    return [now, _smaller(camera), longer]


CAMERA: tuple[Check, ...] = (
    *COMMON,
    check_camera_info_is_complete,
    check_camera_settings_are_achievable,
    check_camera_check_is_a_fixed_point,
    check_camera_check_changes_nothing,
    check_camera_refuses_regions_off_the_sensor,
    check_camera_refuses_meaningless_settings,
    check_camera_configure_tells_the_truth,
    check_camera_configures_while_running,
    check_camera_start_and_stop_repeat,
    check_camera_restart_resets_counters,
    check_camera_closes_while_running,
    *FRAMES,
)


def camera_checks(max_level: int = 3) -> list[Check]:
    """Checks for a :class:`~escape_hw.api.camera.Camera`.

    Parameters
    ----------
    max_level
        Leave out what changes more: 0 takes frames as it is set, 2 changes settings and back.
    """
    return up_to(CAMERA, max_level)
