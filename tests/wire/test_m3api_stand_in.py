"""The stand-in of libm3api alone, and with XIMEA's wrapper."""

from __future__ import annotations

import ctypes
import importlib
import importlib.util
import sys
import threading
import time
from ctypes import byref, c_float, c_int, c_uint32, c_void_p, sizeof

import numpy as np
import pytest
from driver_bench import fresh

from escape_drivers.ximea.library import XiImage, XimeaLibrary


@pytest.fixture
def xi():
    return fresh("m3api")


@pytest.fixture
def camera(xi):
    library = XimeaLibrary("wfs", str(xi.path))
    library.open("SIMWFS")
    return library


def image(size=288):
    return XiImage(size=size)


def get(camera, picture, wait_ms=200):
    return camera.c.xiGetImage(camera.handle, wait_ms, byref(picture))


def test_the_structure_is_laid_out_as_in_the_header() -> None:
    assert sizeof(XiImage) == 288
    offsets = {
        "size": 0, "bp": 8, "bp_size": 16, "frm": 20, "width": 24, "height": 28, "nframe": 32, "tsSec": 36,
        "tsUSec": 40, "GPI_level": 44, "black_level": 48, "padding_x": 52, "AbsoluteOffsetX": 56,
        "AbsoluteOffsetY": 60, "transport_frm": 64, "img_desc": 68, "DownsamplingX": 180,
        "DownsamplingY": 184, "flags": 188, "exposure_time_us": 192, "gain_db": 196, "acq_nframe": 200,
        "image_user_data": 204,
        "exposure_sub_times_us": 208, "data_saturation": 232, "wb": 240, "black_levels": 252, "ranges": 260,
        "gain_ratio": 268, "fDownsampling": 272, "color_filter_array": 280,
    }  # fmt: skip
    assert {name: getattr(XiImage, name).offset for name in offsets} == offsets


@pytest.mark.parametrize("size", [0, 100, 287, 289, 296])
def test_a_wrong_size_of_the_structure_is_caught(xi, camera, size) -> None:
    camera.start()
    assert get(camera, image(size)) == 11
    assert xi.violations == [f"xiGetImage: no version of this library has an XI_IMG of {size} bytes"]


@pytest.mark.parametrize("size", [36, 48, 52, 56, 64, 68, 180, 192, 200, 204, 228, 240, 252, 272, 280, 284])
def test_only_what_fits_is_filled(camera, size) -> None:
    camera.start()
    picture = image(size)
    ctypes.memset(ctypes.addressof(picture) + size, 0xA5, 288 - size)
    assert get(camera, picture) == 0
    beyond = ctypes.string_at(ctypes.addressof(picture) + size, 288 - size)
    assert beyond == b"\xa5" * (288 - size)
    assert picture.width == 1280


def test_the_order_of_calls_is_watched(xi, camera) -> None:
    assert get(camera, image()) == 45
    camera.start()
    assert camera.c.xiStartAcquisition(camera.handle) == 41
    assert camera.c.xiSetParamInt(camera.handle, b"width", 640) == 114
    assert camera.c.xiSetParamFloat(camera.handle, b"exposure", 500.0) == 0
    handle = camera.handle
    camera.close()
    assert camera.c.xiGetImage(handle, 1, byref(image())) == 1
    assert xi.violations == [
        "width cannot be set while the camera is acquiring",
        "xiCloseDevice: the camera is acquiring; xiStopAcquisition first",
        "xiGetImage: the handle is not that of an open camera",
    ]


def test_closing_under_a_waiting_reader_is_caught(xi, camera) -> None:
    camera.set("trigger_source", 1)
    camera.start()
    reader = threading.Thread(target=get, args=(camera, image(), 400))
    reader.start()
    time.sleep(0.1)
    camera.stop()
    reader.join()
    assert xi.violations == ["xiStopAcquisition: xiGetImage is still waiting in another thread"]


@pytest.mark.parametrize(
    ("name", "value", "code"),
    [
        (b"width", 642, 101), (b"width", 1288, 11), (b"offsetX", 8, 11), (b"exposure", 100, 103),
        (b"imgdataformat", 8, 11), (b"device_sn", 1, 100), (b"nonsense", 1, 100), (b"chip_temp", 1, 103),
        (b"isexist", 1, 109), (b"trigger_software", 1, 0),
    ],
)  # fmt: skip
def test_parameters_have_a_type_a_range_and_an_increment(xi, camera, name, value, code) -> None:
    assert camera.c.xiSetParamInt(camera.handle, name, value) == code
    assert bool(xi.violations) == (code in (11, 101, 103))


def test_offsets_keep_the_size_within_the_sensor(camera) -> None:
    camera.set("width", 640)
    camera.set("offsetX", 640)
    assert camera.get_int("width:max") == 640
    assert camera.c.xiSetParamInt(camera.handle, b"width", 648) == 11


def test_the_frame_rate_follows_rows_exposure_and_mode(camera) -> None:
    assert camera.c.xiSetParamFloat(camera.handle, b"framerate", c_float(100)) == 119, "free run"
    camera.set("acq_timing_mode", 1)
    camera.set("exposure", 100.0)
    assert camera.get_float("framerate:max") == pytest.approx(1e6 / (20 + 4.65 * 1024))
    camera.set("height", 400)
    assert camera.get_float("framerate:max") == pytest.approx(1e6 / (20 + 4.65 * 400))
    camera.set("framerate", 500.0)
    camera.set("exposure", 10000.0)
    assert camera.get_float("framerate") == pytest.approx(1e6 / 10030)


def test_faults_come_at_the_requested_call(xi, camera) -> None:
    xi.script("xiGetImage 2 timeout 10; xiGetImage 3 error 13; xiGetImage 4 reset; xiGetImage 6 unplug 56")
    camera.set("exposure", 100.0)
    camera.start()
    picture = image()
    assert [get(camera, picture) for _ in range(4)] == [0, 10, 13, 55]
    assert camera.get_float("exposure") == 10000, "a reset forgets every setting"
    assert get(camera, picture) == 45
    assert get(camera, picture) == 56
    assert camera.c.xiStopAcquisition(camera.handle) == 56
    number = c_uint32()
    camera.c.xiGetNumberDevices(byref(number))
    assert number.value == 0


def test_the_safe_policy_wants_a_buffer_that_is_large_enough(camera) -> None:
    camera.set("buffer_policy", 1)
    camera.set("imgdataformat", 6)
    camera.start()
    picture, pixels = image(), np.zeros((1024, 1280), np.uint16)
    picture.bp, picture.bp_size = pixels.ctypes.data, 1000
    assert get(camera, picture) == 58
    picture.bp_size = pixels.nbytes
    assert get(camera, picture) == 0
    assert pixels[2, 5] == (15 + 14) & 255


def test_generic_calls_want_four_bytes_and_the_right_type(xi, camera) -> None:
    value, size, kind = c_int(640), c_uint32(4), c_int(0)
    c, handle = camera.c, camera.handle
    assert c.xiSetParam(handle, b"width", byref(value), 8, 0) == 104
    assert c.xiSetParam(handle, b"width", byref(value), 4, 1) == 103
    assert c.xiSetParam(handle, b"width", byref(value), 4, 0) == 0
    assert c.xiGetParam(handle, b"width", byref(value), byref(size), byref(kind)) == 0
    assert (value.value, size.value) == (640, 4)
    assert len(xi.violations) == 2


def test_selectors_other_than_the_serial_number_are_not_obliged(xi) -> None:
    library = XimeaLibrary("wfs", str(xi.path))
    handle = c_void_p()
    assert library.c.xiOpenDeviceBy(0, b"SIMWFS", byref(handle)) == 106
    assert library.c.xiOpenDeviceBy(1, b"OTHER", byref(handle)) == 56
    assert library.c.xiOpenDevice(c_uint32(1), byref(handle)) == 56


@pytest.mark.skipif(
    importlib.util.find_spec("ximea") is None,
    reason="needs XIMEA's wrapper, which comes without a licence: pip install 'escape-hw[ximea-client]'",
)
def test_ximeas_own_wrapper_runs_on_the_stand_in(xi, monkeypatch) -> None:
    load = ctypes.CDLL
    # It loads the library from one fixed place; only that name is replaced.
    monkeypatch.setattr(
        ctypes, "CDLL", lambda name, *a: load(str(xi.path) if "m3api" in str(name) else name, *a)
    )
    for name in [name for name in sys.modules if name.split(".")[0] == "ximea"]:
        monkeypatch.delitem(sys.modules, name)
    xiapi = importlib.import_module("ximea.xiapi")
    camera = xiapi.Camera()
    camera.open_device_by_SN("SIMWFS")
    camera.set_imgdataformat("XI_RAW16")
    camera.set_exposure(1000)
    camera.set_width(640)
    assert camera.get_exposure() == 1000
    camera.start_acquisition()
    picture = xiapi.Image()
    camera.get_image(picture)
    data = picture.get_image_data_numpy()
    assert data.shape == (1024, 640)
    assert data[3, 7] == 21 + 21
    camera.stop_acquisition()
    with pytest.raises(xiapi.Xi_error) as stopped:
        camera.get_image(picture)
    assert stopped.value.status == 45
    camera.close_device()
    assert not xi.violations
