"""The driver of an adaptive secondary over a real socket: contract, and every call received."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from asm_bench import PATIENCE_S, as_driver, driver, emulator, port_of, wait_for

from escape_drivers.asm import messages as m
from escape_drivers.asm.codec import AsmCodec
from escape_drivers.asm.mirror import AsmMirror
from escape_drivers.asm.observer import AsmObserver
from escape_hw.api.adaptive_secondary import ShellState
from escape_hw.bench import build_device
from escape_hw.config.loader import load_system
from escape_hw.errors import ConfigError, DeviceError, FrameTimeout, SettingRejected
from escape_hw.testing import Check, Factory, parametrize_device_checks
from escape_sim.emulators.asm.emulator import PORT, AsmEmulator

# --------------------------------------------------------------------- contract
_SHARED: list[AsmEmulator] = []


@pytest.fixture(scope="module")
def shared_emulator() -> Iterator[AsmEmulator]:
    with emulator() as made:
        _SHARED.append(made)
        yield made
        _SHARED.clear()


def on_the_wire() -> AsmMirror:
    """A mirror on the emulator of this file; during collection there is none yet, and nothing is opened."""
    return driver(port_of(_SHARED[0]) if _SHARED else PORT)


def on_the_twin() -> AsmMirror:
    words = ["devices.dm.mode=hardware", "devices.dm.options.host=emulator"]
    return as_driver(load_system("maps-nir", overrides=words))


@parametrize_device_checks({"asm": on_the_wire})
def test_contract(shared_emulator: AsmEmulator, factory: Factory, check: Check) -> None:
    before = len(shared_emulator.violations)
    check(factory)
    assert not shared_emulator.violations[before:]


@pytest.mark.slow
def test_a_run_that_only_collects_this_file_ends() -> None:
    words = [sys.executable, "-m", "pytest", "--collect-only", "-q", "-p", "no:cacheprovider", __file__]
    done = subprocess.run(words, cwd=Path(__file__).parents[2], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr


def test_an_emulator_whose_thread_has_ended_is_stopped_without_waiting() -> None:
    with emulator() as made:
        loop, thread = made._loop, made._thread
        assert loop is not None
        assert thread is not None
        loop.call_soon_threadsafe(loop.stop)
        thread.join(PATIENCE_S)
        made.stop()
        assert loop.is_closed()


def test_an_emulator_that_hangs_is_left_after_a_while(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("escape_sim.emulators.asm.emulator.STOP_S", 0.05)
    go_on = threading.Event()
    with emulator() as made:
        loop, thread = made._loop, made._thread
        assert loop is not None
        assert thread is not None
        loop.call_soon_threadsafe(go_on.wait)
        made.stop()
    go_on.set()
    thread.join(PATIENCE_S)
    assert not thread.is_alive()
    loop.run_until_complete(asyncio.gather(*asyncio.all_tasks(loop), return_exceptions=True))
    loop.close()


def test_an_emulator_joins_the_twin() -> None:
    mirror = on_the_twin()
    with mirror:
        assert mirror.info.simulated
        mirror.send(np.full(336, 0.01) * _enabled(mirror))
        assert mirror.measured_positions().shape == (336,)
    assert not mirror.is_open


def _enabled(mirror: AsmMirror) -> np.ndarray:
    mask = np.ones(336)
    mask[list(mirror.limits.disabled)] = 0.0
    return mask


# --------------------------------------------------------------------- call by call
def test_every_call_of_a_session_arrives_in_order() -> None:
    with emulator() as made:
        mirror = driver(port_of(made))
        shape = np.linspace(-0.05, 0.05, 336) * _enabled(mirror)
        with mirror:
            mirror.send(shape)
            mirror.send(0.5 * shape)
        calls = [(name, what) for name, what in made.server.calls if name != "HEARTBEAT"]
        assert made.violations == ()
    names = [name for name, _ in calls]
    assert names == [
        "SET_STATE", "SET_STATE", "SET_STATE", "COMMAND", "COMMAND", "COMMAND", "SET_STATE", "SET_STATE",
    ]  # fmt: skip
    states = [what for name, what in calls if name == "SET_STATE"]
    assert states == [
        ShellState.RESTED,
        ShellState.SET,
        ShellState.RUNNING,
        ShellState.SET,
        ShellState.RESTED,
    ]
    sent = [np.asarray(what) for name, what in calls if name == "COMMAND"]
    # Metres of surface from flat: fractions of a stroke of 10 um.
    assert sent[0] == pytest.approx(shape * 1e-5, abs=1e-12)
    assert sent[1] == pytest.approx(shape * 0.5e-5, abs=1e-12)
    assert not sent[2].any()


def test_disabled_actuators_are_reported_and_never_driven() -> None:
    off = [7, 259, 260, 261, 262, 263, 319, 320, 321, 322, 323]
    with emulator() as made, driver(port_of(made), f"devices.dm.limits.disabled={off}") as mirror:
        assert made.server.calls[0] == ("SET_DISABLED", (tuple(off), "limits.disabled"))
        report = mirror.send(np.full(336, 0.01))
        assert report.guard.disabled == 11
        name, what = made.server.calls[-1]
        assert name == "COMMAND"
        assert not np.asarray(what)[[7, 259, 323]].any()


def test_numbers_on_the_wire_are_those_of_the_hardware() -> None:
    """Commands, positions and actuators out of service, with a hardware that counts mirrored and pulls."""
    off = [7, 259, 260, 261, 262, 263, 319, 320, 321, 322, 323]
    words = (f"devices.dm.limits.disabled={off}", "devices.dm.order=left-right", "devices.dm.polarity=-1")
    config = load_system("maps-nir", overrides=["devices.dm.mode=hardware", *words])
    order = config.devices.dm.hardware_order()
    assert order is not None
    with emulator() as made:
        in_hardware = [int(np.flatnonzero(order == k)[0]) for k in off]
        made.controller.contaminated = set(in_hardware[1:])
        options = {"port": port_of(made), "reply_s": 10.0, "heartbeat_s": 600.0}
        chosen = [f"devices.dm.options.{key}={value}" for key, value in options.items()]
        config = load_system("maps-nir", overrides=["devices.dm.mode=hardware", *words, *chosen])
        shape = np.linspace(-0.05, 0.05, 336)
        shape[off] = 0.0
        with build_device("dm", config, AsmMirror) as mirror:
            name, (disabled, _) = made.server.calls[0]
            assert (name, set(disabled)) == (
                "SET_DISABLED",
                {int(np.flatnonzero(order == k)[0]) for k in off},
            )
            assert mirror.health.contaminated == tuple(off[1:])
            assert np.array_equal(mirror.send(shape).sent, shape)
            name, what = made.server.calls[-1]
            assert name == "COMMAND"
            assert np.asarray(what) == pytest.approx(-shape[order] * 1e-5, abs=1e-12)
            wait_for(lambda: bool(np.allclose(mirror.measured_positions(), shape, atol=3e-3)), "it moved")
        assert made.violations == ()


def test_acknowledgements_bring_positions_and_times() -> None:
    with emulator() as made, driver(port_of(made)) as mirror:
        shape = 0.02 * _enabled(mirror)
        ack = mirror._link.command(shape * mirror.info.stroke_m)
        assert ack.result is m.Result.APPLIED
        assert 0 < ack.received_ns <= ack.applied_ns
        wait_for(lambda: bool(np.allclose(mirror.measured_positions(), shape, atol=3e-3)), "it moved")


def test_a_failed_sensor_is_nan_and_no_other() -> None:
    with emulator() as made, driver(port_of(made)) as mirror:
        made.inject("unreadable:5")
        wait_for(lambda: bool(np.isnan(mirror.measured_positions()[5])), "the sensor went blind")
        assert np.isnan(mirror.measured_positions()).sum() == 1


def test_a_skipped_command_keeps_the_shape_and_is_reported() -> None:
    with emulator() as made, driver(port_of(made)) as mirror:
        made.inject("skip")
        skipped = mirror.send(0.02 * _enabled(mirror))
        assert skipped.skipped
        assert not skipped.sent.any()
        assert not mirror.shape.any()
        assert not mirror.send(0.01 * _enabled(mirror)).skipped
        assert mirror.health.skipped == 1


def test_too_many_skipped_commands_in_a_row_are_an_error() -> None:
    with emulator() as made, driver(port_of(made), max_skips=3) as mirror:
        for _ in range(3):
            made.inject("skip")
        for _ in range(2):
            assert mirror.send(np.zeros(336)).skipped
        with pytest.raises(DeviceError, match=r"skipped 3 commands in a row .* lower limits.max_slew"):
            mirror.send(np.zeros(336))


def test_a_mirror_that_skips_on_and_on_opens_the_loop() -> None:
    with emulator() as made, driver(port_of(made), max_skips=1000) as mirror:
        for _ in range(100):
            made.inject("skip")
        for _ in range(100):
            assert mirror.send(np.zeros(336)).skipped
        with pytest.raises(DeviceError, match=r"is set and follows no commands"):
            mirror.send(np.zeros(336))


def test_a_mirror_left_set_stays_set() -> None:
    with emulator() as made:
        with driver(port_of(made)) as mirror:
            mirror.leave_set = True
        assert made.controller.shell.state is ShellState.SET
        with driver(port_of(made), lift=False) as again:
            assert again.state is ShellState.SET
        assert made.violations == ()


def test_many_may_observe_while_one_controls() -> None:
    with emulator() as made, driver(port_of(made)) as owner:
        others = [driver(port_of(made)) for _ in range(5)]
        for other in others:
            health = other.observe_health()
            assert health.state is ShellState.RUNNING
            assert "pid" in health.owner
            assert health.contaminated == owner.limits.disabled
        assert owner.send(np.zeros(336)).guard.is_unchanged
        assert made.violations == ()


def test_another_serial_number_is_refused() -> None:
    with emulator() as made:
        with pytest.raises(DeviceError, match=r"is 'SIM336', not 'MMT336'; correct serial or the address"):
            driver(port_of(made), "devices.dm.serial=MMT336").observe_health()
        assert made.violations == ()


def test_a_second_owner_is_refused_with_the_name_of_the_first() -> None:
    with emulator() as made, driver(port_of(made)) as owner:
        with pytest.raises(DeviceError, match=r"not owner.*pid \d+ controls it"):
            driver(port_of(made)).open()
        owner.send(np.zeros(336))


def test_parameters_are_set_and_read_back() -> None:
    with emulator() as made, driver(port_of(made)) as mirror:
        assert mirror.set_parameter("telemetry_hz", 5.0) == mirror.parameter("telemetry_hz") == 5.0
        with pytest.raises(DeviceError, match=r"telemetry_hz must lie in 0\.1\.\.100"):
            mirror.set_parameter("telemetry_hz", 1e9)
        with pytest.raises(DeviceError, match="no parameter 'gain'"):
            mirror.parameter("gain")


# --------------------------------------------------------------------- refusals before anything moves
@pytest.mark.parametrize(
    ("override", "error", "words"),
    [
        ("devices.dm.serial=OTHER", DeviceError, "is 'SIM336', not 'OTHER'"),
        ("devices.dm.limits.max_stroke=0.9", SettingRejected, "skips commands beyond 0.8"),
        ("devices.dm.limits.max_slew=0.6", SettingRejected, "max_slew is 0.6"),
        ("devices.dm.limits.disabled=[1]", SettingRejected, r"disabled = \[1, 259, 260, 261, 262, 263"),
        ("devices.dm.layout=rings-672", DeviceError, "has 336 actuators"),
    ],
)
def test_another_mirror_than_configured_is_refused(
    override: str, error: type[DeviceError], words: str
) -> None:
    more = (override, "devices.dm.limits.disabled=[]") if "rings" in override else (override,)
    with emulator() as made:
        with pytest.raises(error, match=words):
            driver(port_of(made), *more).open()
        assert made.controller.shell.state is ShellState.OFF
        assert not [name for name, _ in made.server.calls if name in ("SET_STATE", "COMMAND")]


def test_new_contamination_is_reported_with_the_line_to_configure() -> None:
    with emulator(contaminated="17") as made, pytest.raises(SettingRejected, match=r"disabled = \[17, 259"):
        driver(port_of(made)).open()


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("hots=x", "did you mean 'host'"),
        ("port=0", "allowed range 1 <= x <= 65535"),
        ("reply_s=-1.0", "reply_s: -1.0  is out of range"),
        ("max_skips=0", "max_skips: 0  is out of range"),
        ("lift=1", "must be a valid boolean"),
    ],
)
def test_wrong_options_are_refused(word: str, message: str) -> None:
    config = load_system("maps-nir", overrides=[f"devices.dm.options.{word}"])
    with pytest.raises(ConfigError, match=message):
        as_driver(config)


def test_a_version_that_the_mirror_does_not_speak_is_named() -> None:
    with emulator(versions="2,3") as made, pytest.raises(DeviceError, match="versions 2 to 3 are supported"):
        driver(port_of(made)).open()


def test_another_codec_replaces_only_the_codec() -> None:
    class Counting(AsmCodec):
        made = 0

        def __init__(self) -> None:
            super().__init__()
            type(self).made += 1

    with emulator() as made, AsmMirror("SIM336", port=port_of(made), make_codec=Counting) as mirror:
        mirror.send(np.zeros(336))
    assert Counting.made >= 1


def test_observation_sends_nothing_on_a_quiet_link(caplog: pytest.LogCaptureFixture) -> None:
    with emulator() as made, driver(port_of(made), heartbeat_s=0.02) as mirror:
        seen = len(made.server.calls)
        wait_for(lambda: len(made.server.calls) > seen + 3, "signs of life")
        assert mirror.state is ShellState.RUNNING
    assert not [r for r in caplog.records if r.levelno >= logging.WARNING]


# --------------------------------------------------------------------- observers
def test_observers_see_what_the_owner_does() -> None:
    with emulator() as made, driver(port_of(made)) as owner:
        owner.set_parameter("telemetry_hz", 100.0)
        shape = 0.02 * _enabled(owner)
        owner.send(shape)
        with contextlib.ExitStack() as stack:
            observers = [
                stack.enter_context(AsmObserver("watch", "127.0.0.1", port_of(made))) for _ in range(9)
            ]
            for observer in observers:
                sample = observer.sample(30.0)
                assert sample.state is ShellState.RUNNING
                assert sample.position.shape == sample.current.shape == sample.flags.shape == (336,)
                enabled = np.flatnonzero(_enabled(owner))
                assert sample.command[enabled] == pytest.approx(0.02e-5)
                assert set(np.flatnonzero(sample.flags & 8)) == set(owner.limits.disabled)
            made.inject("trip")
            for observer in observers:
                while observer.fault is None:
                    observer.sample(30.0)
                assert observer.fault.text == "panic (scripted)"
        owner.recover()
        assert made.violations == ()


def test_an_observer_that_sleeps_gets_the_newest() -> None:
    with emulator() as made:
        owner = driver(port_of(made)).open()
        owner.set_parameter("telemetry_hz", 100.0)
        with AsmObserver("watch", "127.0.0.1", port_of(made)) as observer:
            first = observer.sample(30.0)
            wait_for(lambda: time.monotonic_ns() - first.time_ns > 0.5e9, "time passes")
            behind = time.monotonic_ns() - observer.sample(30.0).time_ns
            assert behind < 0.4e9
            wait_for(lambda: _has_health(observer), "health every second")
            made.stop()
            with pytest.raises(DeviceError, match="link to"):
                _watch_on(observer)
        with pytest.raises(DeviceError):
            owner.close()


def _watch_on(observer: AsmObserver) -> None:
    for _ in range(1000):
        observer.sample(30.0)


def _has_health(observer: AsmObserver) -> bool:
    observer.sample(30.0)
    return observer.health is not None


def test_silence_is_reported_to_an_observer() -> None:
    with emulator() as made, AsmObserver("watch", "127.0.0.1", port_of(made)) as observer:
        made.controller.parameters["telemetry_hz"] = 1e-9
        with contextlib.suppress(FrameTimeout):
            observer.sample(0.3)  # one may have been on its way
        with pytest.raises(FrameTimeout, match=r"no telemetry within 0\.05 s"):
            observer.sample(0.05)
