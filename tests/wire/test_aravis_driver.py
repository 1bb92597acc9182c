"""Calls of the Aravis driver to libaravis, its handling of every reply, and Aravis's fake cameras."""

from __future__ import annotations

import ctypes
import os
import time
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from itertools import pairwise

import numpy as np
import pytest
from driver_bench import end_wait, fresh, make, stand_in

from escape_drivers.aravis import AravisCamera
from escape_drivers.aravis.library import ARAVIS, AravisLibrary, ReceivedBuffer
from escape_hw.api.camera import Region
from escape_hw.errors import ConfigError, DeviceError, DeviceLost, FrameTimeout, SettingRejected
from escape_hw.testing import Check, Factory, parametrize_device_checks

OPENING = [
    "arv_update_device_list",
    "arv_camera_new FLIR-Stand-in",
    "arv_camera_get_model_name",
    "arv_camera_set_pixel_format_from_string Mono16",
    "arv_camera_set_string ExposureAuto Off",
    "arv_camera_set_string GainAuto Off",
    "arv_camera_set_boolean AcquisitionFrameRateEnable 1",
    "arv_camera_set_region 0 0 720 540",
    "arv_camera_set_region 0 0 128 128",
    "arv_camera_set_region 296 206 128 128",
    "arv_camera_set_exposure_time 19000",
    "arv_camera_set_gain 0",
    "arv_camera_set_frame_rate 50",
]


def pixels(bits: int, format_: str, shift: int = 0) -> tuple[str, ...]:
    """Overrides for pixels of this kind."""
    options = {"bit_depth": bits, "options.pixel_format": f'"{format_}"', "options.shift": shift}
    return tuple(f"devices.science.{key}={value}" for key, value in options.items())


READS = ("arv_camera_get_", "arv_camera_is_", "arv_stream_")


@pytest.fixture
def arv():
    yield fresh("aravis")
    stand_in("aravis").clear()


def said(arv):
    model = "arv_camera_get_model_name"
    return [line for line in arv.calls if line == model or not line.startswith(READS)]


def test_every_call_of_a_session_in_order(arv) -> None:
    with make("aravis") as camera:
        assert said(arv) == OPENING
        frame = camera.next_frame(1.0)
        y, x = np.mgrid[:128, :128]
        assert np.array_equal(frame.data, (3 * x + 7 * y) & 4095)
    assert said(arv)[len(OPENING) :] == [
        "arv_camera_create_stream", "arv_camera_start_acquisition", "arv_camera_stop_acquisition",
        "g_object_unref stream", "g_object_unref camera",
    ]  # fmt: skip
    assert not arv.violations
    assert arv.library.escape_stand_in_leaks() == 0


def test_the_older_name_of_the_rate_switch_is_found(arv) -> None:
    arv.script("set rate_switch AcquisitionFrameRateEnabled")
    with make("aravis") as camera:
        assert "arv_camera_set_boolean AcquisitionFrameRateEnabled 1" in arv.calls
        camera.next_frame(1.0)
    assert not arv.violations


def test_block_65535_is_followed_by_1_and_nothing_is_lost(arv) -> None:
    arv.script("set first_frame 65530")
    with make("aravis", "devices.science.frame_rate_hz=200", "devices.science.exposure_s=1e-3") as camera:
        indices = [camera.next_frame(1.0).index for _ in range(12)]
        assert indices == list(range(65530, 65542))
        assert camera.status().lost == 0


def test_lost_and_damaged_frames_are_counted(arv) -> None:
    arv.script("arv_stream_timeout_pop_buffer 2 drop 3; arv_stream_timeout_pop_buffer 3 error 3")
    with make("aravis", "devices.science.frame_rate_hz=500", "devices.science.exposure_s=1e-3") as camera:
        indices = [camera.next_frame(1.0).index for _ in range(3)]
        assert np.diff(indices).tolist() == [4, 2]
        assert (camera.status().lost, camera.incomplete_frames) == (4, 1)


@pytest.mark.parametrize(
    ("format_", "bits", "shift", "top"),
    [("Mono16", 12, 0, 4095), ("Mono16", 12, 4, 255), ("Mono12", 12, 0, 4095), ("Mono8", 8, 0, 255)],
)
def test_pixel_formats(arv, format_, bits, shift, top) -> None:
    with make("aravis", *pixels(bits, format_, shift)) as camera:
        data = camera.next_frame(1.0).data
        assert data.dtype == np.uint16
        assert data.max() <= top
        assert data[3, 5] == (15 + 21) >> shift


@pytest.mark.parametrize(
    ("bits", "format_", "shift", "message"),
    [
        (12, "Mono10", 0, "bit_depth is 12, but pixel_format 'Mono10' has 10 bits; set bit_depth = 10"),
        (10, "Mono12", 0, "bit_depth is 10, but pixel_format 'Mono12' has 12 bits; set bit_depth = 12"),
        (10, "Mono8", 0, "bit_depth is 10, but pixel_format 'Mono8' has 8 bits"),
        (8, "Mono10", 0, "bit_depth is 8, but pixel_format 'Mono10' has 10 bits"),
        (16, "Mono16", 4, "bit_depth is 16, but shift = 4 leaves 12 of 16 bits; correct one of them"),
        (10, "Mono16", 4, "bit_depth is 10, but shift = 4 leaves 12 of 16 bits"),
        (8, "Mono8", 2, "bit_depth is 8, but shift = 2 leaves 6 of 8 bits"),
    ],
)
def test_a_bit_depth_that_is_not_that_of_the_pixels(arv, bits, format_, shift, message) -> None:
    with pytest.raises(ConfigError, match=f"science: {message}"):
        make("aravis", *pixels(bits, format_, shift))


@pytest.mark.parametrize(
    ("bits", "format_", "shift"), [(10, "Mono16", 0), (12, "Mono16", 4), (12, "Mono12", 4), (10, "Mono10", 6)]
)
def test_words_that_contain_fewer_bits(arv, bits, format_, shift) -> None:
    assert make("aravis", *pixels(bits, format_, shift)).info.bit_depth == bits


@pytest.mark.parametrize(
    ("options", "bits"),
    [({}, 16), ({"shift": 4}, 12), ({"pixel_format": "Mono10"}, 10), ({"pixel_format": "Mono8"}, 8)],
)
def test_the_bit_depth_follows_from_the_format(options, bits) -> None:
    assert AravisCamera("17", **options).info.bit_depth == bits


def test_a_missing_pixel_format_is_refused_with_those_there_are(arv) -> None:
    with pytest.raises(
        DeviceError, match=r"has no pixel format 'Mono10' \(there are: Mono16, Mono12, Mono8\)"
    ):
        make("aravis", *pixels(10, "Mono10")).open()
    arv.script("arv_camera_set_pixel_format_from_string 2 error 1")
    with pytest.raises(DeviceError, match="from_string: scripted error"):
        make("aravis").open()
    assert arv.library.escape_stand_in_leaks() == 0
    assert not arv.violations


def test_the_camera_of_revolt(arv, caplog) -> None:
    arv.script("set profile c-blue-one")
    settings = {
        "library": arv.path, "pixel_format": "Mono10", "frame_rate_hz": 500.0, "region": (627, 377, 351, 351)
    }  # fmt: skip
    with AravisCamera("SIMCBLUE", exposure_s=1.99e-3, **settings) as camera:
        assert camera.settings.region == Region(628, 378, 350, 350)
        assert camera.info.full_scale == 1023
    assert "reads [628, 378, 350, 350]" in caplog.text
    with pytest.raises(SettingRejected, match=r"an exposure of 0\.002 s allow at most 498\.8"):
        AravisCamera("SIMCBLUE", exposure_s=2e-3, **settings).open()
    with pytest.raises(ConfigError, match=r"aravis\.pixel_format: 'Mono10p'  must be 'Mono16', "):
        AravisCamera("SIMCBLUE", **settings | {"pixel_format": "Mono10p"})
    assert not arv.violations


def test_a_buffer_shorter_than_the_frame_is_never_read(arv) -> None:
    with make("aravis") as camera:
        held = ctypes.create_string_buffer(100)
        short = ReceivedBuffer(ctypes.addressof(held), 100, 0, 1, 1, 128, 128)
        with pytest.raises(DeviceError, match="delivered 128 x 128 pixels in 100 bytes"):
            camera._pixel_counts(short)


def test_newest_skips_what_waits(arv) -> None:
    with make(
        "aravis", "devices.science.options.newest=true", "devices.science.frame_rate_hz=500",
        "devices.science.exposure_s=1e-3",
    ) as camera:  # fmt: skip
        first = camera.next_frame(1.0).index
        time.sleep(0.05)
        assert camera.next_frame(1.0).index - first > 10
    assert not arv.violations


def test_settings_go_to_the_increments_and_are_read_back(arv) -> None:
    arv.script("set increment 4")
    with make("aravis") as camera:
        made = camera.configure(replace(camera.settings, region=Region(3, 5, 101, 33), frame_rate_hz=20))
        assert made.region == Region(4, 8, 100, 28)
        before = camera.settings
        with pytest.raises(SettingRejected, match=r"540 rows and an exposure of 0.001 s allow at most 178"):
            camera.configure(
                replace(before, region=Region(0, 0, 720, 540), exposure_s=1e-3, frame_rate_hz=500)
            )
        assert camera.settings == before
    assert not arv.violations


def test_a_region_off_the_increments_is_reported(arv, caplog) -> None:
    with make("aravis", "devices.science.region=[297,207,127,127]") as camera:
        assert camera.settings.region == Region(298, 208, 126, 126)
    assert (
        "science: the region [297, 207, 127, 127] is not in the camera's steps (size 2 x 2, offsets 2 and 2"
        "); it reads [298, 208, 126, 126]"
    ) in caplog.text
    caplog.clear()
    with make("aravis"):
        pass
    assert "steps" not in caplog.text


def test_what_is_wrong_at_opening(arv) -> None:
    with pytest.raises(DeviceError, match=r"no camera with serial number '17' \(found: SIMSCI\)"):
        make("aravis", 'devices.science.serial="17"').open()
    with pytest.raises(DeviceError, match="sensor_px is 800 x 600; correct sensor_px to what the camera is"):
        make("aravis", "devices.science.sensor_px=[800,600]").open()
    with make("aravis"), pytest.raises(DeviceError, match="camera_new: busy: used by another process"):
        make("aravis").open()
    with pytest.raises(ConfigError, match="did you mean 'shift'"):
        make("aravis", "devices.science.options.shfit=4")
    assert arv.library.escape_stand_in_leaks() == 0


def test_a_silent_camera_is_asked_whether_it_is_there(arv) -> None:
    with make("aravis") as camera:
        camera.next_frame(1.0)
        arv.script("arv_stream_timeout_pop_buffer 1.. timeout 1")
        with pytest.raises(FrameTimeout, match=r"no frame within 0\.1 s"):
            camera.next_frame(0.1)
        arv.script("arv_camera_get_exposure_time 1.. unplug")
        with pytest.raises(DeviceLost, match=r"does not answer any more .* check cable and power"):
            camera.next_frame(0.1)


def test_a_long_time_out_never_outlasts_close(arv) -> None:
    arv.script("arv_stream_timeout_pop_buffer 1.. timeout 1")
    camera = make("aravis").open()
    end_wait(camera, camera.close)
    assert not arv.violations


@pytest.mark.parametrize(
    ("misuse", "violation"),
    [
        (("g_object_unref camera", "g_object_unref camera"), "g_object_unref: no such object"),
        (("stream", "g_object_unref camera"), "the camera is released before its stream"),
        (("start",), "arv_camera_start_acquisition: no stream, or no buffer in it"),
        (
            ("stream", "push", "start", "g_object_unref stream"),
            "the stream is released while the camera acquires",
        ),
        (("stream", "push", "push again"), "a buffer pushed twice"),
        (("region",), "region 1 0 100 100 does not fit the sensor"),
    ],
)
def test_the_stand_in_catches_what_the_real_library_leaves_undefined(arv, misuse, violation) -> None:
    library = AravisLibrary("science", str(arv.path))
    library.open("SIMSCI")
    library.call("camera_set_boolean", b"AcquisitionFrameRateEnable", 1)
    c, made = library.c, {"camera": library.camera}
    for step in misuse:
        if step == "stream":
            made["stream"] = ctypes.c_void_p(library.call("camera_create_stream", None, None))
        elif step.startswith("push"):
            made.setdefault("buffer", c.arv_buffer_new_allocate(720 * 540))
            c.arv_stream_push_buffer(made["stream"], made["buffer"])
        elif step == "start":
            with nullcontext() if "stream" in made else pytest.raises(DeviceError):
                library.call("camera_start_acquisition")
        elif step == "region":
            with pytest.raises(DeviceError, match="region out of range"):
                library.call("camera_set_region", 1, 0, 100, 100)
        else:
            c.g_object_unref(made[step.split()[1]])
    assert any(violation in line for line in arv.violations), arv.violations


# ---- Aravis's own simulated camera, where the library is installed --------------------------------------
FAKE = (
    'devices.science.options.interface="Fake"', 'devices.science.serial="1"', "devices.science.bit_depth=16",
    "devices.science.sensor_px=[2048,2048]", "devices.science.region=[128,128,256,256]",
    "devices.science.exposure_s=2e-3", "devices.science.frame_rate_hz=100",
    'devices.science.options.library=""',
)  # fmt: skip


def _aravis_is_there() -> bool:
    for name in (os.environ.get(ARAVIS.variable), *ARAVIS.default):
        try:
            if name:
                ctypes.CDLL(name)
                return True
        except OSError:
            continue
    return False


needs_aravis = pytest.mark.skipif(
    not _aravis_is_there(), reason="Aravis is not installed; get it with: apt install libaravis-0.8-0"
)


@needs_aravis
@parametrize_device_checks({"aravis-fake": partial(make, "aravis", *FAKE)})
def test_contract_on_aravis_own_fake_camera(factory: Factory, check: Check) -> None:
    check(factory)


@needs_aravis
def test_the_fake_cameras_counter_starts_over() -> None:
    fast = (
        "devices.science.frame_rate_hz=1000", "devices.science.exposure_s=1e-4",
        "devices.science.region=[0,0,64,64]",
    )  # fmt: skip
    with make("aravis", *FAKE, *fast) as camera:
        indices = [camera.next_frame(1.0).index for _ in range(400)]
    assert indices[0] < 65536 < indices[-1]
    assert all(b > a for a, b in pairwise(indices))


@needs_aravis
def test_the_fake_camera_reports_that_it_is_simulated() -> None:
    with make("aravis", *FAKE) as camera:
        assert camera.info.simulated
        assert camera.info.model == "Fake (stand-in)"
