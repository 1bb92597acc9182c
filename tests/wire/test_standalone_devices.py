"""Drivers used alone, without a system file: geometry from the device, cautious limits, the same guard."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from asm_bench import emulator, port_of
from driver_bench import fresh, stand_in

import escape_hw
from escape_drivers.alpao import AlpaoMirror
from escape_drivers.aravis import AravisCamera
from escape_drivers.asm import AsmMirror
from escape_drivers.common.options import known_layout
from escape_drivers.pi import PiModulator
from escape_drivers.streams import MilkMirror
from escape_drivers.ximea import XimeaCamera
from escape_hw.api.adaptive_secondary import ShellState
from escape_hw.config.layouts import layout_map, positions
from escape_hw.config.loader import load_system
from escape_hw.errors import ConfigError, DeviceError, NotOpen, SettingRejected
from escape_hw.safety.limits import CAUTIOUS_LIMITS
from escape_hw.testing import Check, Factory, parametrize_device_checks

pytestmark = pytest.mark.usefixtures("short_auto_zero")


def mirror(**settings) -> AlpaoMirror:
    fresh("asdk", "set serial BAX118")
    return AlpaoMirror(serial="bax118", library=stand_in("asdk").path, **settings)


def camera(**settings) -> XimeaCamera:
    fresh("m3api", "set serial 12345678")
    return XimeaCamera(serial="12345678", library=stand_in("m3api").path, **settings)


def stage(**settings) -> PiModulator:
    return PiModulator(serial=123456789, kind="emulator", **settings)


@parametrize_device_checks({"alpao": mirror, "ximea": camera, "pi-e727": stage})
@pytest.mark.slow
def test_contract(factory: Factory, check: Check) -> None:
    check(factory)


def test_a_mirror_takes_its_geometry_from_the_sdk() -> None:
    dm = mirror()
    with pytest.raises(NotOpen, match="number of actuators is known once it is open"):
        dm.info  # noqa: B018
    with dm:
        assert (dm.info.n_act, dm.info.serial, dm.info.simulated) == (97, "BAX118", True)
        assert dm.info.layout is not None
        assert dm.info.layout.shape == (11, 11)
        assert np.ptp(dm.info.positions_m[:, 0]) == pytest.approx(10 * 1.5e-3)
        assert math.isnan(dm.info.stroke_m)
        assert dm.limits is CAUTIOUS_LIMITS
    with mirror(pitch_m=2.5e-3, stroke_m=3e-6, layout="circle-11") as dm:
        assert np.ptp(dm.info.positions_m[:, 0]) == pytest.approx(25e-3)
        assert dm.info.stroke_m == 3e-6


@pytest.mark.parametrize(("n_act", "rows"), [(69, 9), (97, 11), (241, 17), (277, 19), (468, 24), (820, 32)])
def test_layouts_of_alpaos_mirrors(n_act: int, rows: int) -> None:
    grid = layout_map(known_layout(n_act))
    assert grid.sum() == n_act
    assert grid.shape == (rows, rows)
    assert np.array_equal(grid, grid.T), "no direction of the grid is special"
    assert np.array_equal(grid, grid[::-1, ::-1])


def test_a_mirror_of_277_actuators_has_the_layout_of_revolt() -> None:
    dm = mirror()
    stand_in("asdk").script("set actuators 277")
    with dm:
        expected = load_system("revolt-shwfs").devices.dm.info("", simulated=True)
        assert np.array_equal(dm.info.layout, expected.layout)
        assert np.array_equal(dm.info.positions_m, expected.positions_m)


def test_actuators_of_an_unknown_arrangement_are_all_neighbours(caplog: pytest.LogCaptureFixture) -> None:
    dm = mirror()
    stand_in("asdk").script("set actuators 192")
    with dm:
        assert "arrangement of its 192 actuators is not known; max_neighbour limits" in caplog.text
        assert dm.info.layout is None
        assert dm.info.positions_m.shape == (192, 2)
        shape = dm.flat
        shape[5] = 0.1
        assert dm.send(shape).guard.is_unchanged
        for _ in range(3):
            shape[[0, 191]] = 0.3, -0.3
            sent = dm.send(shape).sent
        assert np.ptp(sent) <= 0.4 + 1e-9
    assert not stand_in("asdk").violations


def test_a_layout_may_be_a_file(tmp_path: Path) -> None:
    grid = layout_map("circle-11")
    np.savetxt(tmp_path / "mask.txt", grid, fmt="%d")
    np.savetxt(tmp_path / "positions.txt", positions("maps-336"))
    with mirror(layout=f"mask:{tmp_path}/mask.txt") as dm:
        assert np.array_equal(dm.info.layout, grid)
    with emulator() as made:
        words = {"port": port_of(made), "layout": f"positions:{tmp_path}/positions.txt", "pitch_m": 0.03}
        with AsmMirror("SIM336", reply_s=10.0, **words) as device:
            np.testing.assert_allclose(device.info.positions_m, 0.03 * positions("maps-336"), atol=1e-9)


def test_a_mirror_opened_again_may_be_another_one() -> None:
    dm = mirror()
    for n_act, rows in ((97, 11), (69, 9), (192, 0)):
        stand_in("asdk").script(f"set actuators {n_act}")
        with dm:
            assert dm.info.n_act == n_act
            assert (0 if dm.info.layout is None else len(dm.info.layout)) == rows
    stand_in("asdk").script("set actuators 97")
    with dm:
        dm.set_flat(np.full(97, 0.01))
    stand_in("asdk").script("set actuators 69")
    with pytest.raises(SettingRejected, match="its flat shape is of 97 actuators, and it has 69; make a new"):
        dm.open()
    assert not stand_in("asdk").violations


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"layout": "circle-x"}, "layout: layout 'circle-x' is unknown; choose 'circle-N', .* 'mask:FILE'"),
        ({"layout": "mask:/nowhere"}, "layout: the mask '/nowhere' cannot be read .No such file"),
        ({"pitch_m": "1.5e-3"}, "pitch_m: '1.5e-3'  must be a valid number .allowed range 0 < x <= 1"),
        ({"pitch_m": -1.5e-3}, "pitch_m: -0.0015  is out of range .allowed range 0 < x <= 1"),
        ({"pitch_m": math.nan}, "pitch_m: nan  must be a finite number"),
        ({"stroke_m": 0}, "stroke_m: 0  is out of range .allowed range 0 < x <= 0.001"),
        ({"stroke_m": "3e-6"}, "stroke_m: '3e-6'  must be a valid number"),
        ({"limits": {"max_stork": 0.1}}, "limits.max_stork: unknown option .did you mean 'max_stroke'"),
        ({"limits": {"max_stroke": "0.1"}}, "limits.max_stroke: '0.1'  must be a valid number"),
        ({"limits": 0.1}, "limits: 0.1  must be MirrorLimits or a table"),
        ({"serial": None}, "^serial: None  must be text or a whole number"),
    ],
)
@pytest.mark.parametrize("kind", [AlpaoMirror, AsmMirror, MilkMirror])
def test_geometry_and_limits_are_checked_before_a_mirror_is_opened(kind, wrong, message) -> None:
    words = {"stream": "s"} if kind is MilkMirror else {}
    with pytest.raises(ConfigError, match=message):
        kind(**{"serial": "1", "name": "dm", **words, **wrong})


def test_a_mirror_used_alone_takes_a_table_of_limits_and_a_whole_serial_number() -> None:
    fresh("asdk", "set serial 118")
    with AlpaoMirror(118, library=str(stand_in("asdk").path), limits={"max_stroke": 0.1}) as dm:
        assert (dm.info.serial, dm.limits) == ("118", replace(CAUTIOUS_LIMITS, max_stroke=0.1))
    assert AsmMirror(336, limits={"max_stroke": 0.1}).limits == replace(CAUTIOUS_LIMITS, max_stroke=0.1)
    assert AsmMirror(336).limits is CAUTIOUS_LIMITS


def test_the_guard_limits_every_command_of_a_mirror_used_alone() -> None:
    with mirror() as dm:
        report = dm.send(np.full(97, 1.0))
        assert np.abs(report.sent).max() <= 0.2, "slew"
        for _ in range(10):
            report = dm.send(np.where(np.arange(97) % 2, 1.0, -1.0))
        assert np.abs(report.sent).sum() <= 20 + 1e-9
        assert np.array_equal(stand_in("asdk").shape(97), report.sent)
        with pytest.raises(escape_hw.errors.CommandRejected):
            dm.send(np.full(97, np.nan))
    assert not stand_in("asdk").violations


def test_settings_of_a_device_used_alone_are_checked() -> None:
    with pytest.raises(ConfigError, match=r"^alpao\.triger_in: unknown option \(did you mean 'trigger_in'\?"):
        mirror(triger_in="off")
    with pytest.raises(ConfigError, match=r"did you mean 'stroke_m'. there are: serial, .*layout, pitch_m,"):
        mirror(strok_m=1e-6)
    with pytest.raises(ConfigError, match="by its serial number only"):
        AlpaoMirror(serial=" ")
    with pytest.raises(ConfigError, match=r"ximea\.queue: 0  is out of range"):
        camera(queue=0)
    with pytest.raises(ConfigError, match=r"modulator\.port: 0  is out of range"):
        PiModulator(serial="1", host="10.0.0.1", port=0)


def test_a_camera_takes_the_size_of_its_sensor_from_the_library() -> None:
    with camera(exposure_s=2e-4, frame_rate_hz=100.0) as device:
        rows, columns = device.info.sensor_shape
        assert rows > 0
        assert device.settings.region == escape_hw.Region(0, 0, columns, rows)
        assert device.next_frame(5.0).data.shape == (rows, columns)
    with camera(region=np.array([16, 8, 64, 32]), exposure_s=2e-4, frame_rate_hz=100.0) as device:
        assert device.next_frame(5.0).data.shape == (32, 64)
    with pytest.raises(DeviceError, match="sensor_px is 5 x 5"):
        camera(sensor_px=(5, 5)).open()


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"region": (-16, 0, 64, 64)}, "ximea.region.0.: -16  must be greater than or equal to 0"),
        ({"region": (0, 0, 64)}, "ximea.region: .0, 0, 64.  has too few items"),
        ({"exposure_s": -1}, "ximea.exposure_s: -1  is out of range .allowed range 1e-06 <= x <= 60"),
        ({"exposure_s": math.nan}, "ximea.exposure_s: nan  must be a finite number"),
        ({"exposure_s": "1e-3"}, "ximea.exposure_s: '1e-3'  must be a valid number"),
        ({"exposure_s": 0.5}, "ximea.exposure_s: 0.5  longer than a frame .0.1 s at 10 Hz"),
        ({"frame_rate_hz": 0}, "ximea.frame_rate_hz: 0  is out of range"),
        ({"bit_depth": 99}, "ximea.bit_depth: 99  is out of range .allowed range 8 <= x <= 16"),
        ({"exposure": 1e-3}, "unknown option .did you mean 'exposure_s'. there are: .* bit_depth, .*queue"),
        ({"frame_rate": 10.0}, "unknown option .did you mean 'frame_rate_hz'"),
    ],
)
def test_settings_of_a_camera_are_those_of_a_system_file(wrong, message) -> None:
    with pytest.raises(ConfigError, match=message):
        camera(**wrong)


def test_a_region_off_the_sensor_is_refused() -> None:
    device = camera(region=(1200, 900, 400, 400))
    with pytest.raises(SettingRejected, match="does not lie on the sensor of 1280 x 1024 pixels"):
        device.open()
    assert not device.is_open
    assert not stand_in("m3api").violations
    fresh("aravis", "set serial 17")
    device = AravisCamera(serial=17, region=(0, 500, 64, 64), library=stand_in("aravis").path)
    with pytest.raises(SettingRejected, match="does not lie on the sensor of 720 x 540 pixels"):
        device.open()


def test_serial_numbers_may_be_whole_numbers() -> None:
    fresh("m3api", "set serial 12345678")
    with XimeaCamera(serial=12345678, library=str(stand_in("m3api").path)) as device:
        assert device.info.serial == "12345678"
    with stage() as device:
        assert device.info.serial == "123456789"
    for wrong in (None, 1.5, True):
        with pytest.raises(ConfigError, match=f"^serial: {wrong}  must be text or a whole number"):
            PiModulator(serial=wrong)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"serial": ""}, "serial: ''  a real device is opened by its serial number only"),
        ({"max_tilt_rad": -1}, "modulator.max_tilt_rad: -1  is out of range .allowed range 0 < x <= 0.1"),
        ({"max_tilt_rad": "1e-3"}, "modulator.max_tilt_rad: '1e-3'  must be a valid number"),
        ({"max_tilt": 1e-3}, "modulator.max_tilt: unknown option .did you mean 'max_tilt_rad'"),
        ({"stage": {"axes": ["1", "1"]}}, "modulator.stage.axes: .'1', '1'.  the two axes must differ"),
        ({"stage": {"axis": ["1", "2"]}}, "modulator.stage.axis: unknown option .did you mean 'axes'"),
        ({"stage": 5}, "modulator.stage: 5  must be"),
    ],
)
def test_settings_of_a_stage_are_checked(wrong, message) -> None:
    with pytest.raises(ConfigError, match=message):
        PiModulator(**{"serial": "1", "kind": "emulator", **wrong})


def test_a_stage_is_limited_to_a_small_tilt() -> None:
    with stage() as device:
        assert device.info.max_tilt_rad == 1e-3
        with pytest.raises(SettingRejected):
            device.modulate(escape_hw.Modulation(1.1e-3, 200.0))
        assert device.modulate(escape_hw.Modulation(2e-4, 200.0)).frequency_hz > 0
        device.park()


def test_a_secondary_reports_everything_but_its_serial_number() -> None:
    with emulator() as made:
        port = port_of(made)
        with pytest.raises(DeviceError, match="is 'SIM336', not 'OTHER'"):
            AsmMirror("OTHER", port=port).open()
        device = AsmMirror(serial="SIM336", port=port, reply_s=10.0)
        with device:
            assert device.state is ShellState.RUNNING
            assert device.info.n_act == 336
            assert 0 < device.info.stroke_m < 1
            assert device.limits.max_stroke <= 0.5
            actuator = int(np.setdiff1d(np.arange(336), device.limits.disabled)[0])
            shape = device.flat
            shape[actuator] = 0.02
            assert device.send(shape).guard.is_unchanged
        assert not made.violations


def test_a_device_is_opened_by_the_name_of_its_driver() -> None:
    fresh("asdk", "set serial BAX118")
    path = str(stand_in("asdk").path)
    with escape_hw.open_device("alpao", serial="BAX118", library=path) as dm:
        assert isinstance(dm, AlpaoMirror)
        assert dm.is_open
    for driver, missing, option in (
        ("alpao", "serial", "--serial NUMBER"),
        ("pi-e727", "serial", "--serial NUMBER"),
        ("pyrtc-camera", "stream", "--set stream=..."),
    ):
        text = f"driver '{driver}' needs {missing}, which is missing; .* {option}"
        with pytest.raises(ConfigError, match=text):
            escape_hw.open_device(driver)
    with pytest.raises(ConfigError, match="'sim-alpao' works as a part of a system only"):
        escape_hw.open_device("sim-alpao")
    with pytest.raises(ConfigError, match=r"driver is None; it must be the name of one"):
        escape_hw.open_device(None)
    with pytest.raises(ConfigError, match=r"alpao\.layout: 5  must be a string"):
        escape_hw.open_device("alpao", serial="BAX118", layout=5)


def test_limits_of_a_device_used_alone_may_be_a_table() -> None:
    fresh("asdk", "set serial BAX118")
    words = {"serial": "BAX118", "library": str(stand_in("asdk").path)}
    with escape_hw.open_device("alpao", limits={"max_stroke": 0.3}, **words) as dm:
        assert dm.limits == replace(CAUTIOUS_LIMITS, max_stroke=0.3)
    with escape_hw.open_device("alpao", limits={"disabled": tuple(np.arange(2))}, **words) as dm:
        assert dm.limits == replace(CAUTIOUS_LIMITS, disabled=(0, 1))
    for wrong, message in (
        ({"max_stork": 0.3}, "alpao.limits.max_stork: unknown option .did you mean 'max_stroke'"),
        ({"max_stroke": 3}, "alpao.limits.max_stroke: 3  is out of range"),
        (5, "alpao.limits: 5  must be MirrorLimits or a table .* --set limits.max_stroke=0.3"),
    ):
        with pytest.raises(ConfigError, match=message):
            escape_hw.open_device("alpao", limits=wrong, **words)


def test_numbering_sign_and_flip_are_given_as_in_a_system_file() -> None:
    fresh("asdk", "set serial BAX118")
    words = {"serial": "BAX118", "library": str(stand_in("asdk").path)}
    order = load_system("razor-shwfs").devices.dm.hardware_order("left-right")
    for numbering in (
        {"order": "left-right", "layout": "circle-11"},
        {"order": f"numbers:{','.join(map(str, order))}"},
    ):
        with escape_hw.open_device("alpao", polarity=-1, **numbering, **words) as dm:
            shape = dm.flat
            shape[order[0]] = 0.1
            dm.send(shape)
            assert stand_in("asdk").shape(97)[0] == -0.1
    for wrong, message in (
        ({"polarity": 2}, "alpao.polarity: 2  must be -1 or 1"),
        ({"order": "left-right"}, "alpao.order: 'left-right'  needs the arrangement .*; give layout"),
        ({"order": "left-right", "layout": "points:0,0;1,0;5,0"}, "does not map onto itself"),
        ({"flip": "left-right"}, "alpao.flip: unknown option"),
    ):
        with pytest.raises(ConfigError, match=message):
            escape_hw.open_device("alpao", **wrong, **words)
    fresh("m3api", "set serial 12345678")
    words = {"serial": 12345678, "library": str(stand_in("m3api").path), "frame_rate_hz": 100.0}
    region = {"region": (16, 8, 64, 64)}
    with escape_hw.open_device("ximea", **region, **words) as device:
        plain = device.next_frame(5.0).data
    with escape_hw.open_device("ximea", flip="transpose", **region, **words) as device:
        assert np.array_equal(device.next_frame(5.0).data, plain.T)
    with pytest.raises(SettingRejected, match="must be square, since flip"):
        escape_hw.open_device("ximea", flip="turn-90", **words)
    with pytest.raises(ConfigError, match=r"ximea\.flip: 'x'  must be 'none'"):
        escape_hw.open_device("ximea", flip="x", **words)
