"""Devices of a system, built, opened and closed together; with minimal devices."""

import threading
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import escape_hw
import escape_hw.bench
from escape_hw.api.camera import Camera, CameraInfo, CameraSettings, Frame
from escape_hw.api.mirror import DeformableMirror, DMInfo
from escape_hw.api.phase_screen import PhaseScreen, ScreenInfo, ScreenState
from escape_hw.api.procedure import Procedure, Progress
from escape_hw.bench import Bench
from escape_hw.config.loader import load_system
from escape_hw.config.registry import DeviceContext
from escape_hw.config.system import SystemConfig
from escape_hw.errors import Aborted, ConfigError, DeviceError, DeviceLost


class Diary(list[str]):
    """What happened, in order, and which devices fail at what."""

    def __init__(self) -> None:
        super().__init__()
        self.failing: dict[str, BaseException] = {}
        self.members: list[str] = []

    def note(self, event: str) -> None:
        self.append(event)
        if event in self.failing:
            raise self.failing[event]


class FakeMirror(DeformableMirror):
    def __init__(self, name: str, config: SystemConfig, diary: Diary, simulated: bool) -> None:
        super().__init__(name, config.devices.dm.limits.to_limits())
        self.diary, self.config, self.simulated = diary, config, simulated
        self.received: list[np.ndarray[Any, Any]] = []

    @property
    def info(self) -> DMInfo:
        layout = self.config.devices.dm.actuator_map()
        n = int(layout.sum())
        return DMInfo("fake", "F1", n, layout, np.zeros((n, 2)), 1e-6, self.simulated)

    def _open(self) -> None:
        self.diary.note(f"open {self.name}")

    def _close(self) -> None:
        self.diary.note(f"close {self.name}")

    def _send(self, command: np.ndarray[Any, Any]) -> None:
        self.received.append(command)


class FakeCamera(Camera):
    def __init__(self, name: str, config: SystemConfig, diary: Diary, simulated: bool) -> None:
        super().__init__(name)
        self.diary, self.simulated = diary, simulated
        self._settings = config.devices.wfs.settings()

    @property
    def info(self) -> CameraInfo:
        return CameraInfo("fake", "F2", (512, 640), 10, self.simulated)

    @property
    def settings(self) -> CameraSettings:
        return self._settings

    def _open(self) -> None:
        self.diary.note(f"open {self.name}")

    def _close(self) -> None:
        self.diary.note(f"close {self.name}")

    def _check(self, want: CameraSettings) -> CameraSettings:
        return want

    def _configure(self, settings: CameraSettings) -> None:
        self._settings = settings

    def _start(self) -> None:
        self.diary.note(f"start {self.name}")

    def _stop(self) -> None:
        self.diary.note(f"stop {self.name}")

    def _next_frame(self, timeout_s: float) -> Frame:
        region = self._settings.region
        return Frame(np.zeros((region.height, region.width), np.uint16), 0, 0, 0)


class FakeScreen(PhaseScreen):
    def __init__(self, name: str, config: SystemConfig, diary: Diary, simulated: bool) -> None:
        super().__init__(name)
        self.diary, self.simulated = diary, simulated
        self._state = ScreenState(0, True, 1.0)

    @property
    def info(self) -> ScreenInfo:
        return ScreenInfo("fake", "F3", self.simulated)

    @property
    def state(self) -> ScreenState:
        return self._state

    @property
    def n_screens(self) -> int:
        return 4

    def _open(self) -> None:
        self.diary.note(f"open {self.name}")

    def _close(self) -> None:
        self.diary.note(f"close {self.name}")

    def _set(self, want: ScreenState) -> None:
        self._state = want


KINDS: dict[str, Callable[..., object]] = {
    "alpao": FakeMirror,
    "ximea": FakeCamera,
    "science": FakeCamera,
    "aravis": FakeCamera,
    "screen": FakeScreen,
}


@pytest.fixture
def diary(monkeypatch: pytest.MonkeyPatch) -> Diary:
    """A registry that knows the fake devices only; every factory writes into this diary."""
    diary = Diary()

    def device_factory(driver: str, *, hardware: bool = False) -> Callable[..., object]:
        kind = KINDS.get(driver.removeprefix("sim-"))
        if kind is None:
            raise ConfigError(f"no device driver '{driver}' is installed")

        def make(section: object, context: DeviceContext) -> object:
            assert section is getattr(context.require_system().devices, context.name)
            device = kind(context.name, context.system, diary, driver.startswith("sim-"))
            members = context.shared.setdefault("members", [])
            assert isinstance(members, list)
            members.append(context.name)
            diary.members = members
            return device

        return make

    monkeypatch.setattr(escape_hw.bench, "device_factory", device_factory)
    return diary


def test_devices_of_one_bench_share_one_dictionary_and_benches_none(diary: Diary) -> None:
    Bench.from_config(load_system("razor-shwfs"))
    first = diary.members
    Bench.from_config(load_system("razor-shwfs"))
    assert first == diary.members == ["dm", "wfs", "science", "screen"]
    assert first is not diary.members


OPENED = ["open dm", "open wfs", "open science", "open screen"]
CLOSED = ["close screen", "close science", "close wfs", "close dm"]


def test_opens_in_order_and_closes_in_reverse(diary: Diary) -> None:
    bench = Bench.from_config(load_system("razor-shwfs"))
    assert diary == []
    assert not bench.is_open
    with bench:
        assert bench.is_open
        assert diary == OPENED
        bench.open()
        assert diary == OPENED
    assert diary == OPENED + CLOSED
    bench.close()
    assert diary == OPENED + CLOSED


@pytest.mark.usefixtures("diary")
def test_mirror_is_flat_and_cameras_stopped_after_an_error_inside() -> None:
    bench = Bench.from_config(load_system("razor-shwfs"))
    mirror = bench.dm
    assert isinstance(mirror, FakeMirror)

    def use_and_fail() -> None:
        with bench:
            mirror.send(np.full(97, 0.3))
            bench.wfs.next_frame()
            raise RuntimeError("mine")

    with pytest.raises(RuntimeError, match="mine"):
        use_and_fail()
    assert mirror.received[0].max() == 0.3
    assert not mirror.received[-1].any()
    assert not bench.wfs.is_running
    assert not bench.is_open


@pytest.mark.parametrize("failing", ["wfs", "science", "screen"])
def test_a_device_that_does_not_open_leaves_nothing_open(diary: Diary, failing: str) -> None:
    diary.failing[f"open {failing}"] = DeviceLost(failing, "unplugged")
    bench = Bench.from_config(load_system("razor-shwfs"))
    with pytest.raises(DeviceLost, match=f"{failing}: unplugged"):
        bench.open()
    opened = [event.split()[1] for event in diary if event.startswith("open")][:-1]
    assert [event for event in diary if event.startswith("close")] == [f"close {d}" for d in reversed(opened)]
    assert not any(device.is_open for device in bench.devices)


@pytest.mark.parametrize("error", [DeviceError("wfs", "stuck"), KeyboardInterrupt()])
def test_one_device_that_does_not_close_keeps_no_other_open(diary: Diary, error: BaseException) -> None:
    diary.failing["close wfs"] = error
    diary.failing["close dm"] = DeviceError("dm", "stuck too")
    bench = Bench.from_config(load_system("razor-shwfs")).open()
    with pytest.raises(type(error)) as caught:
        bench.close()
    assert diary[4:] == CLOSED
    assert any("stuck too" in note for note in caught.value.__notes__)
    assert not any(device.is_open for device in bench.devices)


def test_the_error_inside_wins_over_errors_of_closing(diary: Diary) -> None:
    diary.failing["close wfs"] = DeviceError("wfs", "stuck")
    with pytest.raises(ValueError, match="mine") as caught, Bench.from_config(load_system("razor-shwfs")):
        raise ValueError("mine")
    assert any("stuck" in note for note in caught.value.__notes__)
    assert diary[4:] == CLOSED


@pytest.mark.usefixtures("diary")
def test_mode_chooses_driver_or_twin() -> None:
    twins = Bench.from_config(load_system("razor-shwfs"))
    assert twins.simulated
    assert twins.screen is not None

    metal = Bench.from_config(load_system("razor-shwfs", mode="hardware"))
    assert not metal.simulated
    assert metal.screen is None, "the real screen is moved by hand"
    with metal:
        assert not metal.simulated
        assert not metal.dm.info.simulated

    mixed = Bench.from_config(load_system("razor-shwfs", mode="hardware", overrides=["devices.wfs.mode=sim"]))
    assert mixed.simulated
    with mixed:
        assert mixed.wfs.info.simulated
        assert not mixed.dm.info.simulated


@pytest.mark.usefixtures("diary")
@pytest.mark.parametrize("driver", ["devices.dm.driver=sim-alpao", "devices.screen.driver=sim-screen"])
def test_a_driver_that_reports_it_is_simulated_is_accepted(driver: str) -> None:
    bench = Bench.from_config(load_system("razor-shwfs", mode="hardware", overrides=[driver]))
    with bench:
        assert bench.simulated


@pytest.mark.usefixtures("diary")
@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("devices.dm.sim_driver=sim-bmc", "devices.dm: no device driver 'sim-bmc' is installed"),
        (
            "devices.wfs.sim_driver=sim-alpao",
            "devices.wfs: driver 'sim-alpao' creates a FakeMirror, not a Camera",
        ),
        ('devices.dm.sim_driver=""', "devices.dm.sim_driver: ''  names no driver"),
        ('devices.wfs.sim_driver=""', "devices.wfs.sim_driver: ''  names no driver"),
    ],
)
def test_wrong_drivers_are_configuration_errors(override: str, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        Bench.from_config(load_system("razor-shwfs", overrides=[override]))
    assert str(caught.value).startswith(message)


@pytest.mark.usefixtures("diary")
def test_the_random_stream_follows_the_seed_and_is_not_the_plain_one() -> None:
    draws = [Bench.from_config(load_system("razor-shwfs", seed=seed)).rng.random(4) for seed in (1, 1, 2)]
    assert np.array_equal(draws[0], draws[1])
    assert not np.array_equal(draws[0], draws[2])
    assert not np.array_equal(draws[0], np.random.default_rng(1).random(4))


@pytest.mark.usefixtures("diary")
def test_the_model_comes_from_the_registry(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []

    def model_factory(name: str) -> Callable[..., object]:
        asked.append(name)
        return lambda config, grid: SimpleNamespace(config=config, grid=grid)

    monkeypatch.setattr(escape_hw.bench, "model_factory", model_factory)
    bench = Bench.from_config(load_system("razor-shwfs", overrides=["calibration.model=oopao"]))
    model = bench.model()
    assert isinstance(model, SimpleNamespace)
    assert (model.config, model.grid) == (bench.config, None)
    assert asked == ["oopao"]


def test_open_system_gives_an_open_bench_with_what_was_asked(diary: Diary) -> None:
    with escape_hw.open_system("razor-shwfs", set=["loop.gain=0.3"], seed=5) as bench:
        assert diary == OPENED
        assert isinstance(bench, Bench)
        assert (bench.config.loop.gain, bench.config.system.seed) == (0.3, 5)
    assert diary == OPENED + CLOSED


def test_nothing_opens_when_the_configuration_is_wrong(diary: Diary) -> None:
    with pytest.raises(ConfigError, match=r"--set  loop\.gain: 9"):
        escape_hw.open_system("razor-shwfs", set=["loop.gain=9"])
    assert diary == []


def counting(total: int, finished: list[int]) -> Procedure[int]:
    done = 0
    try:
        for done in range(1, total + 1):
            yield Progress("counting", done, total)
    finally:
        finished.append(done)
    return done


@pytest.mark.usefixtures("diary")
def test_run_drives_a_procedure_and_stops_it() -> None:
    finished: list[int] = []
    seen: list[float] = []
    with escape_hw.open_system("razor-shwfs") as bench:
        assert bench.run(counting(4, finished), observers=(lambda p: seen.append(p.fraction),)) == 4
        assert seen == [0.25, 0.5, 0.75, 1.0]
        stop = threading.Event()
        with pytest.raises(Aborted):
            bench.run(counting(4, finished), abort=stop, observers=(lambda p: stop.set(),))
    assert finished == [4, 1]


@pytest.mark.usefixtures("diary")
def test_a_bench_describes_itself() -> None:
    with Bench.from_config(load_system("razor-shwfs", mode="hardware")) as bench:
        assert repr(bench) == "<Bench razor-shwfs, hardware, open>"
    assert repr(Bench.from_config(load_system("razor-shwfs"))) == "<Bench razor-shwfs, simulated, closed>"
