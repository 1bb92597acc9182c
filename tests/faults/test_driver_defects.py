"""Drivers of others that raise or return what their interface does not allow: an error that names them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from small_bench import assert_flat, small

from escape_hw.api.camera import CameraInfo, Frame
from escape_hw.api.device import Device
from escape_hw.api.modulator import Modulation
from escape_hw.calibration.docrime.open_loop import docrime
from escape_hw.cli import main
from escape_hw.config import registry
from escape_hw.errors import DeviceError, SettingRejected
from escape_hw.testing.reference_devices import (
    IdealPhaseScreen,
    IdealSecondary,
    QuantisedModulator,
    RecordingMirror,
    SyntheticCamera,
)

N = RecordingMirror().info.n_act


def fails(*_: object) -> Any:
    raise ZeroDivisionError("division by zero")


def returns(value: object) -> Callable[..., Any]:
    return lambda *_: value


def info_with(base: type[Device], **changes: object) -> property:
    return property(lambda self: replace(base().info, **changes))


def frame_with(**changes: object) -> Callable[..., Frame]:
    def _next_frame(self: Any, timeout_s: float) -> Frame:
        return replace(SyntheticCamera._next_frame(self, timeout_s), **changes)

    return _next_frame


def settings_with(**changes: object) -> Callable[..., Any]:
    return lambda self, want: replace(SyntheticCamera._check(self, want), **changes)


def use(device: Any) -> None:
    """Call every hook of a device."""
    with device:
        match device:
            case IdealSecondary():
                device.send(np.full(N, 0.1))
                device.measured_positions()
                assert device.health
            case RecordingMirror():
                device.send(np.full(N, 0.1))
            case SyntheticCamera():
                device.configure(device.settings)
                device.next_frame()
                device.poll()
            case QuantisedModulator():
                device.modulate(Modulation(1e-4, 500.0))
                device.status()
            case IdealPhaseScreen():
                device.set(inserted=False)


RAISING = [
    (RecordingMirror, ("_open", "_close", "_send", "_present_shape", "info")),
    (IdealSecondary, ("_state", "_step", "_send_to_shell", "_measure_positions", "_health")),
    (
        SyntheticCamera,
        ("_open", "_close", "_check", "_configure", "_start", "_stop", "_next_frame", "_poll", "info"),
    ),
    (QuantisedModulator, ("_open", "_close", "_check", "_modulate", "_park", "_status", "info")),
    (IdealPhaseScreen, ("_open", "_close", "_set", "info")),
]


@pytest.mark.parametrize(("base", "hook"), [(base, hook) for base, hooks in RAISING for hook in hooks])
def test_an_exception_of_a_driver_is_its_defect(base: type[Device], hook: str) -> None:
    defects = {hook: property(fails) if hook == "info" else fails, "__module__": "acme"}
    device = type("Acme", (base,), defects)()
    with pytest.raises(DeviceError) as caught:
        use(device)
    text = str(caught.value)
    assert text.startswith(f"{device.name}: failed with ZeroDivisionError: division by zero (test_driver_")
    assert text.endswith("this is a defect of its driver, acme.Acme")
    assert (caught.value.device, caught.value.exit_code) == (device.name, 3)
    assert not device.is_open


WRONG: dict[str, tuple[type[Device], str, Any, str]] = {
    "no actuators": (
        RecordingMirror, "info", info_with(RecordingMirror, n_act=0), "at least one actuator",
    ),
    "actuators as text": (
        RecordingMirror, "info", info_with(RecordingMirror, n_act="21"), "info.n_act is '21'",
    ),
    "no positions": (
        RecordingMirror, "info", info_with(RecordingMirror, positions_m=None), "info.positions_m is None",
    ),
    "a layout of numbers": (
        RecordingMirror, "info", info_with(RecordingMirror, layout=np.ones((5, 5))), "neither a map",
    ),
    "no info of a mirror": (RecordingMirror, "info", None, "info is None, not a DMInfo"),
    "a present shape of others": (
        RecordingMirror, "_present_shape", returns(np.zeros(3)), r"present shape is float64\[3\], not 21",
    ),
    "a number of bytes": (RecordingMirror, "_send", returns(42), "shape that it kept is 42"),
    "a kept shape with NaN": (
        RecordingMirror, "_send", returns(np.full(N, np.nan)), "not 21 finite numbers",
    ),
    "no state": (IdealSecondary, "_state", returns(None), "its state is None, not a ShellState"),
    "no health": (IdealSecondary, "_health", returns({}), "its health record is {}"),
    "positions as text": (IdealSecondary, "_measure_positions", returns("flat"), "failed with ValueError"),
    "no info of a camera": (SyntheticCamera, "info", None, "info is None, not a CameraInfo"),
    "a sensor with one side": (
        SyntheticCamera, "info", info_with(SyntheticCamera, sensor_shape=(48,)), "not \\(rows, columns\\)",
    ),
    "no bits": (
        SyntheticCamera, "info", info_with(SyntheticCamera, bit_depth=0), "counts have 1 to 16 bits",
    ),
    "no settings": (SyntheticCamera, "settings", None, "None are no CameraSettings"),
    "no answer": (SyntheticCamera, "_check", returns(None), "None are no CameraSettings"),
    "a region without a type": (
        SyntheticCamera, "_check", settings_with(region=(0, 0, 8, 8)), "are no CameraSettings with a Region",
    ),
    "an exposure as text": (
        SyntheticCamera, "_check", settings_with(exposure_s="1 ms"), "exposure_s is '1 ms'; it must be",
    ),
    "no frame": (SyntheticCamera, "_next_frame", returns(None), "delivered None for a frame"),
    "an array for a frame": (
        SyntheticCamera, "_next_frame", returns(np.zeros((24, 32))), r"delivered float64\[24, 32\]",
    ),
    "a frame without data": (SyntheticCamera, "_next_frame", frame_with(data=None), "data None"),
    "a frame of lists": (SyntheticCamera, "_next_frame", frame_with(data=[[1]]), "not uint16"),
    "a frame of floats": (
        SyntheticCamera, "_next_frame", frame_with(data=np.zeros((24, 32))), r"data float64\[24, 32\], not",
    ),
    "a transposed frame": (
        SyntheticCamera, "_next_frame", frame_with(data=np.zeros((32, 24), np.uint16)),
        r"data uint16\[32, 24\], not uint16 \(24, 32\)",
    ),
    "a frame without a number": (SyntheticCamera, "_next_frame", frame_with(index=None), "index None"),
    "a frame with a time in seconds": (
        SyntheticCamera, "_next_frame", frame_with(exposed_ns=1.5), "exposed_ns 1.5",
    ),
    "no answer of a modulator": (QuantisedModulator, "_check", returns(None), "not a Modulation"),
    "no status": (QuantisedModulator, "_status", returns(None), "not a ModulatorStatus"),
    "no info of a modulator": (QuantisedModulator, "info", None, "not a ModulatorInfo"),
    "no state of a screen": (IdealPhaseScreen, "state", None, "not a ScreenState"),
    "no number of screens": (IdealPhaseScreen, "n_screens", None, "n_screens is None"),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_answer_of_a_driver_is_its_defect(case: str) -> None:
    base, member, wrong, words = WRONG[case]
    device = type("Acme", (base,), {member: wrong})()
    with pytest.raises(DeviceError, match=f"^{device.name}: .*{words}.*defect of its driver"):
        use(device)
    assert not device.is_open


@pytest.mark.parametrize("want", [None, replace(SyntheticCamera().settings, region=(0, 0, 8, 8))])
def test_wrong_settings_of_a_caller_are_no_defect_of_the_driver(want: Any) -> None:
    with SyntheticCamera() as camera, pytest.raises(SettingRejected, match="are no CameraSettings"):
        camera.check(want)


@pytest.mark.parametrize("hook", [fails, returns(None), returns(np.zeros((4, 4)))])
def test_a_camera_with_a_defect_ends_a_procedure_with_a_flat_mirror(hook: Callable[..., Any]) -> None:
    with small() as bench:
        deliver = bench.wfs._next_frame
        bench.wfs._next_frame = lambda timeout_s: (
            deliver(timeout_s) if bench.wfs.last_index < 60 else hook(timeout_s)
        )
        with pytest.raises(DeviceError, match=r"^wfs: .*defect of its driver, escape_sim"):
            bench.run(docrime(bench, frames=400))
        assert_flat(bench)


def test_a_mirror_with_a_defect_is_made_flat() -> None:
    with small() as bench:
        transfer, sent = bench.dm._send, []
        bench.dm._send = lambda command: fails() if len(sent) == 15 else sent.append(0) or transfer(command)
        with pytest.raises(DeviceError, match=r"^dm: failed with ZeroDivisionError"):
            bench.run(docrime(bench, frames=400))
        sent.append(0)
        bench.dm.flatten()
        assert_flat(bench)


class AcmeCamera(SyntheticCamera):
    """A camera whose sensor's size is text."""

    def __init__(self, serial: str) -> None:
        super().__init__()

    @classmethod
    def from_section(cls, section: Any, context: Any) -> AcmeCamera:
        return cls(section.serial)

    @property
    def info(self) -> CameraInfo:
        return replace(super().info, sensor_shape="48 x 64")


def test_a_command_names_the_driver_with_the_defect(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(registry, "_REGISTERED", {"acme": AcmeCamera})
    with pytest.raises(SystemExit) as ended:
        main(["camera", "settings", "--driver", "acme", "--serial", "1"])
    err = capsys.readouterr().err
    assert ended.value.code == 3
    assert "error: camera: info.sensor_shape is '48 x 64', not a tuple; this is a defect" in err
    assert "Traceback" not in err
