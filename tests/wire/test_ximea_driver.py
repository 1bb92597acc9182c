"""Calls of the XIMEA driver to libm3api, and its handling of every reply."""

from __future__ import annotations

import threading
import time
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from driver_bench import end_wait, fresh, make, stand_in
from hypothesis import given, settings
from hypothesis import strategies as st

from escape_drivers.ximea.library import ERRORS, XiImage, describe_error
from escape_hw.api.camera import Region
from escape_hw.config.registry import available
from escape_hw.errors import ConfigError, DeviceError, DeviceLost, FrameTimeout, NotOpen, SettingRejected

SET_UP = [
    "xiOpenDeviceBy 1 SIMWFS",
    "xiSetParamInt aeag 0",
    "xiSetParamInt imgdataformat 6",
    "xiSetParamInt sensor_bit_depth 10",
    "xiSetParamInt output_bit_depth 10",
    "xiSetParamInt image_data_bit_depth 10",
    "xiSetParamInt downsampling_type 0",
    "xiSetParamInt downsampling 2",
    "xiSetParamInt buffer_policy 0",
    "xiSetParamInt buffers_queue_size 4",
    "xiSetParamInt recent_frame 1",
    "xiSetParamInt trigger_source 0",
    "xiSetParamInt acq_timing_mode 1",
    "xiSetParamInt offsetX 0",
    "xiSetParamInt offsetY 0",
]
REGION = [
    "xiSetParamInt offsetX 0",
    "xiSetParamInt offsetY 0",
    "xiSetParamInt width 400",
    "xiSetParamInt height 400",
    "xiSetParamInt offsetX 120",
    "xiSetParamInt offsetY 56",
    "xiSetParamFloat exposure 1900",
    "xiSetParamFloat gain 0",
    "xiSetParamFloat framerate 500",
]


@pytest.fixture
def xi():
    yield fresh("m3api")
    stand_in("m3api").clear()


def said(xi):
    """Calls that change something."""
    return [line for line in xi.calls if not line.startswith("xiGetParam")]


def test_the_driver_is_offered() -> None:
    assert "ximea" in available("escape.devices")


def test_every_call_of_a_session_in_order(xi) -> None:
    with make("ximea") as camera:
        assert said(xi) == SET_UP + REGION
        frame = camera.next_frame(1.0)
        assert said(xi)[len(SET_UP + REGION) :] == ["xiStartAcquisition", "xiGetImage 50 size 288"]
    assert said(xi)[-2:] == ["xiStopAcquisition", "xiCloseDevice"]
    y, x = np.mgrid[:400, :400]
    expected = (3 * x + 7 * y) & 1023
    expected[0, 0] = frame.index
    assert np.array_equal(frame.data, expected)
    assert not xi.violations


def test_a_stand_in_is_never_taken_for_hardware(xi) -> None:
    with make("ximea") as camera:
        assert camera.info.simulated
        assert camera.info.model == "XIMEA MQ013MG-ON (stand-in)"
        assert camera.temperature_c() == 41.5


def test_options_become_parameters(xi) -> None:
    options = {
        "format": "MONO16", "newest": "false", "queue": 8, "zero_rot": "on", "bandwidth_mbit": 2000,
        "exposure_output": "true", "downsampling_type": "skipping",
    }  # fmt: skip
    with make("ximea", *(f"devices.wfs.options.{key}={value}" for key, value in options.items())):
        for line in (
            "imgdataformat 1", "recent_frame 0", "buffers_queue_size 8", "sensor_feature_selector 0",
            "sensor_feature_value 1", "limit_bandwidth 2000", "gpo_selector 1", "gpo_mode 4",
            "downsampling_type 1",
        ):  # fmt: skip
            assert f"xiSetParamInt {line}" in xi.calls, line


def test_the_modulators_edges_start_the_exposures(xi) -> None:
    xi.script("set trigger_hz 303.03")
    with make("ximea", system="razor-pywfs") as camera:
        assert camera.settings.exposure_s == pytest.approx(3266e-6), "3.3 ms would miss every other edge"
        wanted = [
            "gpi_selector 1",
            "gpi_mode 1",
            "trigger_selector 0",
            "trigger_source 1",
            "acq_timing_mode 0",
        ]
        sent = [line.removeprefix("xiSetParamInt ") for line in said(xi)]
        assert sent[sent.index("gpi_selector 1") :][:5] == wanted
        assert not [line for line in xi.calls if line.startswith("xiSetParamFloat framerate")]
        frames = [camera.next_frame(1.0) for _ in range(20)]
        periods = [(b.exposed_ns - a.exposed_ns) / (b.index - a.index) for a, b in pairwise(frames)]
        assert np.median(periods) == pytest.approx(1e9 / 303.03, rel=1e-2)
        xi.script("set trigger_hz 0")
        camera.stop()
        with pytest.raises(FrameTimeout, match="check the trigger and its cable"):
            camera.next_frame(0.1)


@pytest.mark.parametrize("padding", [0, 2, 32])
def test_padded_rows_are_cut(xi, padding) -> None:
    xi.script(f"set padding {padding}")
    with make("ximea") as camera:
        for _ in range(6):
            frame = camera.next_frame(1.0)
            assert np.array_equal(frame.data[:, 5], (15 + 7 * np.arange(400)) & 1023)
            assert frame.data.flags.c_contiguous


def test_frames_are_copied_before_the_ring_turns(xi) -> None:
    with make("ximea") as camera:
        frames = [camera.next_frame(1.0) for _ in range(12)]
    assert [int(frame.data[0, 0]) for frame in frames] == [frame.index for frame in frames]
    assert all(frame.data[0, 1] == 3 for frame in frames), "the stand-in spoils what it handed out before"


@pytest.mark.parametrize("newest", ["true", "false"])
def test_lost_frames_are_counted_from_the_cameras_counter(xi, newest) -> None:
    xi.script("xiGetImage 3 drop 7")
    with make("ximea", f"devices.wfs.options.newest={newest}") as camera:
        first = camera.next_frame(1.0).index
        frames = [camera.next_frame(1.0) for _ in range(4)]
        assert camera.status().lost == frames[-1].index - first - 4 >= 7
        time.sleep(0.05)
        behind = frames[-1].index
        late = camera.next_frame(1.0).index
        # 25 frames went by: with the newest only they are lost, with the queue all but its length.
        assert late - behind > (20 if newest == "true" else 16)


@pytest.mark.parametrize("first", [0, 1, 2**31 - 1])
def test_the_counter_may_begin_anywhere(xi, first) -> None:
    xi.script(f"set first_frame {first}")
    with make("ximea") as camera:
        assert camera.next_frame(1.0).index >= first
        camera.next_frame(1.0)


@pytest.mark.parametrize("filled", [36, 48, 180, 200])
def test_an_older_library_that_fills_less_still_gives_frames(xi, filled) -> None:
    xi.script(f"xiGetImage 1.. short {filled}")
    with make("ximea") as camera:
        frames = [camera.next_frame(1.0) for _ in range(3)]
        assert frames[0].index < frames[1].index < frames[2].index
        assert frames[0].exposed_ns < frames[2].exposed_ns <= frames[2].arrived_ns


def test_a_structure_that_is_not_filled_is_no_frame(xi) -> None:
    xi.script("xiGetImage 1 short 20")
    with make("ximea") as camera:
        with pytest.raises(DeviceError, match=r"delivered 0 x 0 pixels in .* for a region of 400 x 400"):
            camera.next_frame(1.0)
        camera.next_frame(1.0)


@pytest.mark.parametrize("format_", ["RAW16", "MONO16"])
def test_saturated_pixels_are_counted(xi, format_) -> None:
    with make("ximea", f"devices.wfs.options.format={format_}") as camera:
        frame = camera.next_frame(1.0)
    assert frame.n_saturated == np.count_nonzero(frame.data == 1023) > 0


def test_regions_go_to_the_sensors_increments(xi) -> None:
    xi.script("set width_inc 16; set height_inc 4")
    with make("ximea", "devices.wfs.region=[121,57,401,399]") as camera:
        assert camera.settings.region == Region(128, 60, 384, 394)
        shifted = camera.configure(replace(camera.settings, region=Region(600, 500, 40, 12)))
        assert shifted.region == Region(608, 500, 32, 10)
        assert camera.next_frame(1.0).data.shape == (10, 32)
        with pytest.raises(SettingRejected, match=r"contains no region of this camera.* x in steps of 16"):
            camera.check(replace(camera.settings, region=Region(601, 500, 20, 12)))
    assert not xi.violations


@settings(max_examples=40, deadline=None)
@given(
    st.tuples(st.integers(0, 639), st.integers(0, 511)), st.tuples(st.integers(1, 640), st.integers(1, 512)),
    st.integers(1, 64), st.floats(1e-6, 2.0), st.floats(0.8, 4000), st.floats(0, 12),
)  # fmt: skip
def test_check_is_a_fixed_point_and_configure_keeps_to_it(
    corner, size, step, exposure_s, rate_hz, gain_db
) -> None:
    xi = fresh("m3api", f"set width_inc {step if 640 % step == 0 else 8}")
    with make("ximea", "devices.wfs.region=[0,0,640,512]", "devices.wfs.frame_rate_hz=100") as camera:
        x, y = corner
        region = Region(x, y, min(size[0], 640 - x), min(size[1], 512 - y))
        want = replace(
            camera.settings, region=region, exposure_s=exposure_s, frame_rate_hz=rate_hz, gain_db=gain_db
        )
        before = camera.settings
        try:
            answer = camera.check(want)
            assert camera.check(answer) == answer
            assert answer.region.x >= x
            assert answer.region.y >= y
            assert answer.region.x + answer.region.width <= x + region.width
            assert answer.region.y + answer.region.height <= y + region.height
            made = camera.configure(want)
        except SettingRejected:
            assert camera.settings == before
        else:
            assert made.region == answer.region
            assert camera.check(made) == made
            assert made.exposure_s <= 1 / rate_hz * (1 + 1e-6) or made.exposure_s <= 28.1e-6
            assert made.frame_rate_hz == pytest.approx(rate_hz, rel=0.01)
    assert not xi.violations


def test_a_rate_out_of_reach_leaves_the_camera_as_it_was(xi) -> None:
    with make("ximea") as camera:
        before = camera.settings
        tall = replace(before, region=Region(0, 0, 640, 512))
        with pytest.raises(SettingRejected, match=r"512 rows and an exposure of 0.0019 s allow at most 416"):
            camera.configure(tall)
        assert camera.settings == before
        assert camera.next_frame(1.0).data.shape == (400, 400)
        with pytest.raises(SettingRejected, match=r"minimum is 0.8"):
            camera.configure(replace(before, frame_rate_hz=0.5))
    assert not xi.violations


def test_what_the_hardware_does_is_told_not_what_was_asked(xi) -> None:
    with make("ximea") as camera:
        made = camera.configure(replace(camera.settings, exposure_s=1.2345678e-3, frame_rate_hz=123.4))
        assert made.exposure_s == pytest.approx(1235e-6, abs=1e-12)
        assert made.frame_rate_hz == pytest.approx(1e6 / 8104, rel=1e-6)
        xi.script("xiSetParamFloat 1.. ignore")
        assert camera.configure(replace(made, exposure_s=5e-4)).exposure_s == made.exposure_s


def test_the_wrong_downsampling_is_noticed(xi) -> None:
    with pytest.raises(DeviceError, match=r"is read out as 1280 x 1024 pixels, but sensor_px is 640 x 512"):
        make("ximea", "devices.wfs.options.downsampling=1").open()
    assert xi.calls[-1] == "xiCloseDevice"


def test_numbers_out_of_range_are_all_reported_together() -> None:
    wrong = ("downsampling=0", "queue=1", "trigger_margin=0.9")
    with pytest.raises(ConfigError) as refused:
        make("ximea", *(f"devices.wfs.options.{one}" for one in wrong))
    told = str(refused.value).splitlines()
    assert [line.split(":")[0].rpartition(".")[2] for line in told] == [
        "downsampling",
        "queue",
        "trigger_margin",
    ]


def test_one_camera_has_one_owner(xi) -> None:
    with make("ximea"), pytest.raises(DeviceError, match="error 57, the camera is locked; another process"):
        make("ximea").open()


def test_a_camera_that_is_not_there_states_what_to_check(xi) -> None:
    with pytest.raises(DeviceError, match=r"camera 'MQ_1' was not opened: error 56.*permissions"):
        make("ximea", "devices.wfs.serial=MQ_1").open()


@pytest.mark.parametrize("code", sorted(set(ERRORS) - {9, 10}))
def test_every_code_is_explained(xi, code) -> None:
    with make("ximea") as camera:
        camera.next_frame(1.0)
        xi.script(f"xiGetImage 2 error {code}")
        with pytest.raises(DeviceError, match=f"xiGetImage: error {code}, {ERRORS[code][0]}") as failed:
            camera.next_frame(1.0)
        assert isinstance(failed.value, DeviceLost) == (code in (1, 55, 56))
    assert describe_error(999).startswith("error 999, unknown error")


def test_a_buffer_shorter_than_its_rows_is_never_read(xi) -> None:
    with make("ximea") as camera:
        camera.next_frame(1.0)
        short = XiImage(bp=camera._image.bp, bp_size=400 * 400 * 2 - 1, width=400, height=400)
        with pytest.raises(DeviceError, match="delivered 400 x 400 pixels in 319999 bytes"):
            camera._frame_view(short)


def test_a_camera_that_was_reset_has_stopped_already(xi, caplog) -> None:
    xi.script("xiGetImage 1 reset")
    with make("ximea") as camera:
        with pytest.raises(DeviceLost, match=r"error 55, the camera was reset; .* open it again"):
            camera.next_frame(1.0)
        camera.stop()
        assert not caplog.records, "that it has stopped by itself is no failure of stopping"


@pytest.mark.parametrize("call", ["close", "stop"])
def test_a_long_time_out_never_outlasts_close(xi, call) -> None:
    xi.script("set trigger_hz 0")
    camera = make("ximea", "devices.wfs.options.trigger=rising").open()
    end_wait(camera, getattr(camera, call))
    camera.close()
    assert not xi.violations, "neither stopped nor closed while xiGetImage was waiting"


def test_a_reader_that_starts_it_again_while_it_closes_is_stopped_too(xi) -> None:
    camera = make("ximea").open()
    camera.next_frame(1.0)

    def overtaken() -> None:
        camera.stop()
        camera.start()

    camera._before_close = overtaken
    camera.close()
    assert xi.names()[-3:] == ["xiStartAcquisition", "xiStopAcquisition", "xiCloseDevice"]
    assert not xi.violations


def test_readers_and_a_closer_in_many_threads(xi) -> None:
    for _ in range(10):
        camera = make("ximea").open()
        camera.start()
        unexpected: list[BaseException] = []

        def read(camera=camera, unexpected=unexpected) -> None:
            try:
                while True:
                    camera.next_frame(1.0)
            except NotOpen:
                return
            except DeviceError as error:
                # Two readers share one counter: the slower of them may be late.
                if "the counter must increase" not in str(error):
                    unexpected.append(error)

        readers = [threading.Thread(target=read) for _ in range(3)]
        for one in readers:
            one.start()
        time.sleep(0.01)
        camera.close()
        for one in readers:
            one.join(10)
            assert not one.is_alive()
        assert not unexpected
    assert not xi.violations
