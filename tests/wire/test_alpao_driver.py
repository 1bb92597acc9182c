"""Calls of the ALPAO driver to libasdk, and its handling of every reply."""

from __future__ import annotations

import numpy as np
import pytest
from driver_bench import configuration_of, fresh, make, stand_in
from hypothesis import given, settings
from hypothesis import strategies as st

from escape_drivers.alpao.library import ERRORS, describe_error, format_version
from escape_drivers.alpao.mirror import AlpaoMirror
from escape_hw.bench import build_device
from escape_hw.config.registry import available
from escape_hw.errors import CommandRejected, ConfigError, DeviceError, DeviceLost, SettingRejected
from escape_hw.safety.limits import MirrorLimits

OPENING = ["asdkInit SIM97", "asdkGet NbOfActuator", "asdkGet VersionInfo", "asdkSet TriggerIn 0"]
CLOSING = ["asdkStop", "asdkReset", "asdkRelease"]


@pytest.fixture
def asdk():
    yield fresh("asdk")
    stand_in("asdk").clear()


def test_the_driver_is_offered() -> None:
    assert "alpao" in available("escape.devices")


def test_every_call_of_a_session_in_order(asdk) -> None:
    command = np.linspace(-0.1, 0.1, 97)
    with make("alpao") as dm:
        assert asdk.calls == OPENING
        dm.send(command)
        assert np.array_equal(asdk.shape(97), command)
    first, rest = asdk.calls[4], asdk.calls[5:]
    assert first == f"asdkSend {command[0]:.17g} {command[1]:.17g} .. {command[-1]:.17g}"
    assert [line.partition(" ")[0] for line in rest[:-3]] == ["asdkSend"] * (len(rest) - 3)
    assert rest[-4].split()[1:] == ["0", "0", "..", "0"], "flat comes before the reset"
    assert rest[-3:] == CLOSING
    assert not asdk.violations


def test_a_stand_in_is_never_taken_for_hardware(asdk) -> None:
    with make("alpao") as dm:
        assert dm.info.simulated
        assert dm.info.model == "ALPAO mirror, SDK 3.04.05.0612 (stand-in)"


def test_options_become_parameters_in_units_of_the_sdk(asdk) -> None:
    options = {"sync": "return", "ack_timeout_ms": 20, "trigger_in": "falling", "trigger_out": "short"}
    with make("alpao", *(f"devices.dm.options.{key}={value}" for key, value in options.items())):
        assert asdk.calls[3:] == [
            "asdkSet SyncMode 1", "asdkSet AckTimeout 20", "asdkSet TriggerMode 1", "asdkSet TriggerIn 2",
        ]  # fmt: skip


def test_a_trigger_that_another_program_left_on_is_switched_off(asdk) -> None:
    asdk.script("set trigger_in 1")
    with make("alpao") as dm:
        dm.send(np.full(97, 0.01))
        assert asdk.shape(97)[0] == 0.01
    asdk.clear().script("set triggers 0")
    with make("alpao") as dm:
        dm.send(np.full(97, 0.01))
    with pytest.raises(DeviceError, match=r"asdkSet\(TriggerIn, 1\) failed: error 0x10A.*take the option"):
        make("alpao", "devices.dm.options.trigger_in=rising").open()
    assert not asdk.violations


@pytest.mark.parametrize("number", [0x010, 0x032, 0x10A])
def test_electronics_without_a_trigger_need_not_be_told_that_it_is_off(asdk, number) -> None:
    asdk.script(f"asdkSet 1 error {number:#x}")
    with make("alpao") as dm:
        assert dm.is_open


@pytest.mark.parametrize(
    ("fault", "why"),
    [("error 0x104", "0x104, output failed.*check power"), ("timeout 1", "0x10D"), ("error 0", "no reason")],
)
def test_a_trigger_that_cannot_be_switched_off_is_no_open_mirror(asdk, fault, why) -> None:
    asdk.script(f"asdkSet 1 {fault}")
    with pytest.raises(DeviceError, match=rf"asdkSet\(TriggerIn, 0\) failed.*{why}"):
        make("alpao").open()
    assert asdk.names()[-2:] == ["asdkSet", "asdkRelease"]
    assert not asdk.violations


def test_triggered_sequences_follow_each_other_and_closing_waits_for_no_edge(asdk) -> None:
    rows = np.zeros((3, 97))
    rows[1] = 0.01
    with make("alpao", "devices.dm.options.trigger_in=rising") as dm:
        for _ in range(3):
            dm.play_patterns(rows)
        played = [line for line in asdk.calls if line.startswith(("asdkSendPattern", "asdkSet", "asdkStop"))]
        again = ["asdkStop ", "asdkSet TriggerIn 0", "asdkSet TriggerIn 1", "asdkSendPattern 3 1"]
        assert [line.rstrip() for line in played[-8:]] == [line.rstrip() for line in again] * 2
        with pytest.raises(DeviceError, match=r"0x10E, no trigger in time"):
            dm.send(rows[1])
    assert asdk.names()[-3:] == CLOSING
    assert not asdk.shape(97).any()
    assert not asdk.violations


@pytest.mark.parametrize("repeats", [0, 1])
def test_closing_stops_a_triggered_sequence_before_it_switches_the_trigger_off(asdk, repeats) -> None:
    rows = np.zeros((3, 97))
    rows[1] = 0.01
    with make("alpao", "devices.dm.options.trigger_in=rising") as dm:
        dm.play_patterns(rows, repeats)
        n_before = len(asdk.calls)
    closing = [line for line in asdk.calls[n_before:] if not line.startswith("asdkSend")]
    assert closing == ["asdkStop", "asdkSet TriggerIn 0", *CLOSING]
    assert "asdkSend" in asdk.names()[n_before:], "it is ramped flat, not only reset"
    assert not asdk.violations


def test_the_serial_number_goes_out_in_capitals(asdk) -> None:
    asdk.script("set serial BAX118")
    with make("alpao", "devices.dm.serial=bax118"):
        assert asdk.calls[0] == "asdkInit BAX118"


def test_wrong_options_are_refused_before_anything_is_loaded() -> None:
    with pytest.raises(ConfigError) as refused:
        make("alpao", "devices.dm.options.trigger=rising", "devices.dm.options.ack_timeout_ms=1.5")
    text = str(refused.value)
    assert "devices.dm.options.trigger: unknown option (did you mean 'trigger_in'?" in text
    assert "devices.dm.options.ack_timeout_ms: 1.5  must be a valid integer" in text
    with pytest.raises(ConfigError, match=r"options\.ack_timeout_ms: -1  is out of range"):
        make("alpao", "devices.dm.options.ack_timeout_ms=-1")
    with pytest.raises(ConfigError, match="by its serial number only"):
        make("alpao", 'devices.dm.serial=""')


def test_a_missing_library_names_the_searched_places(monkeypatch) -> None:
    dm = make("alpao", 'devices.dm.options.library=""')
    monkeypatch.setenv("ESCAPE_ALPAO_LIBRARY", "/nowhere/libasdk.so")
    with pytest.raises(DeviceError, match=r"/nowhere/libasdk\.so.*option 'library'.*ESCAPE_ALPAO_LIBRARY"):
        dm.open()
    monkeypatch.setenv("ESCAPE_ALPAO_LIBRARY", str(stand_in("asdk").path))
    with dm:
        assert dm.is_open
    monkeypatch.delenv("ESCAPE_ALPAO_LIBRARY")
    with pytest.raises(DeviceError, match=r"libasdk\.so"):
        dm.open()


def test_another_library_is_distinguished_from_the_sdk() -> None:
    with pytest.raises(DeviceError, match="does not export asdkInit"):
        make("alpao", "devices.dm.options.library=libm.so.6").open()


@pytest.mark.parametrize("peeks", [0, 1])
def test_a_failed_init_gives_the_reason_and_is_never_reset(asdk, peeks) -> None:
    asdk.script(f"set errors_stay {peeks}; asdkInit 1 error 0x22; asdkInit 2 invalid_handle 0x20")
    dm = make("alpao")
    with pytest.raises(DeviceError, match=r"error 0x22, no interface in the configuration.*ACECFG"):
        dm.open()
    assert asdk.calls == ["asdkInit SIM97"]
    # A handle without a configuration is no success; it is released and nothing else.
    with pytest.raises(DeviceError, match="error 0x20, the interface library cannot be loaded"):
        dm.open()
    assert asdk.calls[1:] == ["asdkInit SIM97", "asdkRelease"]
    with dm:
        assert dm.is_open, "old entries on the error stack are no failure of this init"
    assert not asdk.violations


def test_a_failure_without_a_reason_is_one(asdk) -> None:
    library = stand_in("asdk")
    with make("alpao") as dm:
        library.script("asdkSend 1 error 0")
        with pytest.raises(DeviceError, match="asdkSend failed; the SDK gives no reason"):
            dm.send(np.zeros(97))


def test_a_wrong_number_of_actuators_is_refused(asdk) -> None:
    dm = make("alpao")
    with dm:
        dm.send(np.full(97, 0.1))
    asdk.clear().script("set actuators 277")
    with pytest.raises(DeviceError, match="has 277 actuators, but the layout 'circle-11' has 97"):
        dm.open()
    assert asdk.calls[-1] == "asdkRelease"
    assert "asdkReset" not in asdk.calls, "nothing had moved"


def test_limits_that_do_not_fit_the_mirror_leave_it_as_it_was(asdk) -> None:
    dm = AlpaoMirror("SIM97", library=str(asdk.path), limits=MirrorLimits(disabled=(97,)))
    with pytest.raises(SettingRejected, match=r"disabled actuators \(97,\) do not all lie in 0\.\.96"):
        dm.open()
    assert asdk.calls == [*OPENING, "asdkRelease"]
    assert not asdk.violations


def test_one_mirror_has_one_owner(asdk) -> None:
    with make("alpao"), pytest.raises(DeviceError, match="error 0x4, already in use"):
        make("alpao").open()
    assert asdk.violations == ["asdkInit: the mirror has an owner already"]


@pytest.mark.parametrize("number", sorted(ERRORS))
def test_every_error_of_the_sdk_is_explained(asdk, number) -> None:
    with make("alpao") as dm:
        asdk.script(f"asdkSend 1 error {number:#x}")
        with pytest.raises(DeviceError, match=f"error 0x{number:X}, {ERRORS[number][0]}") as failed:
            dm.send(np.zeros(97))
        assert isinstance(failed.value, DeviceLost) == (number == 0x101)
        dm.send(np.zeros(97))


def test_an_unknown_error_keeps_the_librarys_words() -> None:
    assert describe_error(0x999, "smoke") == "error 0x999, unknown error; library: smoke"


@given(st.integers(0, 9), st.integers(0, 99), st.integers(0, 99), st.integers(0, 99999))
def test_versions_are_written_as_the_vendor_does(major, minor, patch, build) -> None:
    number = ((major * 100 + minor) * 100 + patch) * 100000 + build
    assert format_version(float(number)) == f"{major}.{minor:02}.{patch:02}.{build:04}"


def test_patterns_reach_the_electronics_and_stop_before_anything_else(asdk) -> None:
    wave = 0.01 * np.sin(np.arange(8) / 8 * 2 * np.pi)[:, None] * np.ones(97)
    with make("alpao") as dm:
        dm.play_patterns(wave, repeats=0)
        assert dm._playing
        dm.play_patterns(wave, repeats=3)
        assert asdk.calls[4:] == ["asdkSendPattern 8 0", "asdkStop", "asdkSendPattern 8 3"]
        dm.send(np.zeros(97))
        assert asdk.names()[7:] == ["asdkStop", "asdkSend"]
        assert not dm._playing
        dm.play_patterns(wave, repeats=0)
    assert asdk.names()[-5:] == ["asdkStop", "asdkSend", "asdkStop", "asdkReset", "asdkRelease"]
    assert not asdk.violations


def test_a_pattern_that_breaks_a_limit_anywhere_is_refused_whole(asdk) -> None:
    still, high = np.zeros((3, 97)), np.zeros((3, 97))
    high[2, 5] = 0.9
    with make("alpao", "devices.dm.limits.max_slew=0.1") as dm:
        for wrong, why in ((high, "shape 2 .* exceeds max_stroke"), (still[:0], "0 shapes")):
            with pytest.raises(CommandRejected, match=why):
                dm.play_patterns(wrong, repeats=0)
        jump = still.copy()
        jump[1:, 5] = [0.1, 0.2]
        dm.play_patterns(jump, repeats=1)
        dm.send(np.zeros(97))
        dm.flatten()
        with pytest.raises(CommandRejected, match=r"shape 0 .* further from the one before than max_slew"):
            dm.play_patterns(jump, repeats=2)
        with pytest.raises(CommandRejected, match=r"not finite|NaN|nan"):
            dm.play_patterns(still * np.nan)
        assert asdk.names().count("asdkSendPattern") == 1


def test_a_refused_pattern_leaves_the_shapes_that_the_mirror_may_have(asdk) -> None:
    with make("alpao", "devices.dm.limits.max_slew=0.1") as dm:
        dm.flatten()
        asdk.script("asdkSend 2 unacknowledged")
        with pytest.raises(DeviceError, match="error 0x10D"):
            dm.send(np.full(97, 0.1))
        with pytest.raises(CommandRejected, match="exceeds max_stroke"):
            dm.play_patterns(np.full((2, 97), 0.9))
        assert not dm.send(np.full(97, -0.1)).sent.any(), "the mirror may have 0.1"


@pytest.mark.parametrize("repeats", [0, 1])
@pytest.mark.parametrize("wanted", [-0.5, 0.5])
def test_the_step_after_a_sequence_is_within_the_slew_rule_from_all_its_shapes(asdk, repeats, wanted) -> None:
    rows, shape = np.zeros((4, 97)), np.zeros(97)
    rows[:, 5], shape[5] = [0.0, 0.1, 0.2, 0.1], wanted
    with make("alpao", "devices.dm.limits.max_slew=0.1") as dm:
        dm.play_patterns(rows, repeats)
        assert dm.send(shape).sent[5] == pytest.approx(0.1)
        assert np.abs(asdk.shape(97) - rows).max() <= 0.1 + 1e-12
        assert dm.send(shape).sent[5] == pytest.approx(0.1 + np.copysign(0.1, wanted)), "known again"
        with pytest.raises(CommandRejected, match=r"shape 0 .* that the mirror may have; flatten"):
            dm.play_patterns([np.full(97, 0.2)])


@settings(max_examples=60, deadline=None)
@given(st.lists(st.floats(allow_nan=True, allow_infinity=True), min_size=97, max_size=97))
def test_whatever_is_sent_the_library_gets_finite_values_within_the_cap(values) -> None:
    asdk = fresh("asdk")
    with make("alpao") as dm:
        try:
            dm.send(values)
        except CommandRejected:
            assert not all(np.isfinite(values))
            assert "asdkSend" not in asdk.names()
        reached = asdk.shape(97)
    assert np.isfinite(reached).all()
    assert np.abs(reached).max() <= 0.8
    assert not asdk.violations


@pytest.mark.parametrize("mode", ["refuse", "ignore", "accept"])
def test_the_guard_does_not_rely_on_the_librarys_range_check(asdk, mode) -> None:
    asdk.script(f"set range {mode}")
    with make("alpao") as dm:
        report = dm.send(np.full(97, 3.0) * np.where(np.arange(97) % 2, 1, -1))
        assert report.guard.clipped == 97
        assert np.array_equal(asdk.shape(97), report.sent)


@pytest.mark.parametrize("max_slew", [None, 0.2])
def test_a_shape_without_acknowledgement_is_flattened(asdk, max_slew) -> None:
    overrides = () if max_slew is None else (f"devices.dm.limits.max_slew={max_slew}",)
    with make("alpao", *overrides) as dm:
        dm.flatten()
        asdk.script("asdkSend 2 unacknowledged")
        with pytest.raises(DeviceError, match="error 0x10D"):
            dm.send(np.full(97, 0.15))
        assert asdk.shape(97).any(), "the mirror moved"
        dm.flatten()
        assert not asdk.shape(97).any()
    assert not asdk.violations


def test_sequences_have_the_numbering_and_the_sign_of_the_hardware(asdk) -> None:
    config = configuration_of("alpao", "devices.dm.order=turn-180", "devices.dm.polarity=-1")
    command = np.linspace(0.0, 0.1, 97)
    with build_device("dm", config, AlpaoMirror) as dm:
        dm.send(0.5 * command)
        assert np.array_equal(asdk.shape(97), -0.5 * command[::-1])
        dm.play_patterns([command])
        assert np.array_equal(asdk.shape(97), -command[::-1])
        assert np.array_equal(dm.shape, command)
        dm.stop_pattern()
