"""The stand-in of libasdk by itself: it detects violations that a tolerant one would accept."""

from __future__ import annotations

import ctypes
from ctypes import byref, c_double, c_uint32, create_string_buffer

import numpy as np
import pytest
from driver_bench import fresh

from escape_drivers.alpao.library import AlpaoLibrary
from escape_sim.stand_ins import StandInUnavailable, build_library

ZEROS = np.zeros(97)


@pytest.fixture
def asdk():
    return fresh("asdk")


@pytest.fixture
def c(asdk):
    return AlpaoLibrary("dm", str(asdk.path)).c


def init(c):
    handle = c.asdkInit(b"SIM97")
    assert handle
    return ctypes.c_void_p(handle)


def address(values):
    return values.ctypes.data_as(ctypes.c_void_p)


def last(c, size=256):
    number, text = c_uint32(), create_string_buffer(256)
    outcome = c.asdkGetLastError(byref(number), text if size else None, size)
    return outcome, number.value


@pytest.mark.parametrize(
    ("calls", "violation"),
    [
        (["asdkRelease"], None),
        (["asdkReset", "asdkRelease"], None),
        (["send", "asdkReset", "asdkRelease"], None),
        (["send", "asdkRelease"], "asdkRelease: the mirror is not at zero; asdkReset first"),
        (["asdkRelease", "send"], "asdkSend: the handle is not that of an open mirror"),
        (["asdkRelease", "asdkRelease"], "asdkRelease: the handle is not that of an open mirror"),
        (["endless", "send"], "asdkSend: a pattern is being sent; asdkStop first"),
        (["endless", "endless"], "asdkSendPattern: a pattern is being sent; asdkStop first"),
        (["endless", "asdkReset"], "asdkReset: a pattern is being sent; asdkStop first"),
        (["endless", "asdkStop", "asdkReset", "asdkRelease"], None),
    ],
)
def test_the_order_of_calls_is_watched(asdk, c, calls, violation) -> None:
    handle = init(c)
    for call in calls:
        if call == "send":
            c.asdkSend(handle, address(ZEROS))
        elif call == "endless":
            c.asdkSendPattern(handle, address(ZEROS), 1, 0)
        else:
            getattr(c, call)(handle)
    assert asdk.violations == ([violation] if violation else [])


def test_reset_after_a_failed_init_is_the_crash_of_the_real_library(asdk, c) -> None:
    asdk.script("asdkInit 1 invalid_handle 0x20")
    handle = init(c)
    c.asdkReset(handle)
    assert asdk.violations == ["asdkReset: asdkInit had failed; the real library may crash here"]


def test_serial_numbers_are_spelt_exactly_and_a_second_owner_is_refused(asdk, c) -> None:
    assert c.asdkInit(b"sim97") is None
    assert last(c) == (0, 0x24)
    init(c)
    assert c.asdkInit(b"SIM97") is None
    assert last(c) == (0, 4)
    assert asdk.violations == ["asdkInit: the mirror has an owner already"]


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1.0000001, -5.0])
def test_values_out_of_range_are_caught(asdk, c, bad) -> None:
    handle, values = init(c), ZEROS.copy()
    values[96] = bad
    assert c.asdkSend(handle, address(values)) == -1
    assert last(c) == (0, 0x11)
    (violation,) = asdk.violations
    assert violation.startswith("asdkSend: value 96 is ")
    assert not asdk.shape(97).any()


@pytest.mark.parametrize(
    ("mode", "outcome", "moved"), [("refuse", -1, 0), ("ignore", 0, 0), ("accept", 0, 2.0)]
)
def test_the_three_accounts_of_what_happens_beyond_full_stroke(asdk, c, mode, outcome, moved) -> None:
    asdk.script(f"set range {mode}")
    assert c.asdkSend(init(c), address(ZEROS + 2.0)) == outcome
    assert asdk.shape(97)[0] == moved


def test_parameters_have_a_direction_a_range_and_no_case(asdk, c) -> None:
    handle, value = init(c), c_double()
    assert c.asdkGet(handle, b"NBOfActuator", byref(value)) == 0
    assert value.value == 97
    for name, x, error in ((b"NbOfActuator", 1, 0x10A), (b"TriggerIn", 3, 0x11), (b"Timeout", 1, 0x10)):
        assert c.asdkSet(handle, name, float(x)) == -1
        assert last(c) == (0, error)
    assert c.asdkGet(handle, b"SyncMode", byref(value)) == -1
    assert asdk.violations == ["asdkSet: TriggerIn = 3, out of range"]


def test_the_error_stack_goes_by_reading_the_text_only(asdk, c) -> None:
    assert last(c)[0] == -1, "empty"
    c.asdkInit(b"OTHER")
    assert last(c, size=0) == (0, 0x24)
    assert last(c) == (0, 0x24)
    assert last(c)[0] == -1
    asdk.script("set errors_stay 1")
    c.asdkInit(b"OTHER")
    assert [last(c) for _ in range(3)] == [(0, 0x24)] * 3


def test_faults_come_at_the_requested_call(asdk, c) -> None:
    asdk.script("asdkSend 2 error 0x104\nasdkSend 3..4 ignore; asdkSend 5 timeout 1; asdkStop 1 unplug")
    handle = init(c)
    ones = ZEROS + 0.5
    outcomes = [c.asdkSend(handle, address(ZEROS if k == 0 else ones)) for k in range(5)]
    assert outcomes == [0, -1, 0, 0, -1]
    assert not asdk.shape(97).any(), "neither a failed nor an ignored transfer arrives"
    assert c.asdkSend(handle, address(ones)) == 0
    assert c.asdkStop(handle) == -1
    assert c.asdkSend(handle, address(ones)) == -1
    assert last(c) == (0, 0x101)
    assert c.asdkInit(b"SIM97") is None


def test_a_fault_may_count_every_call(asdk, c) -> None:
    asdk.script("* 3 error 0x102")
    handle = init(c)
    assert [c.asdkStop(handle) for _ in range(3)] == [0, -1, 0]


@pytest.mark.parametrize(
    "rule", ["asdkSend 0 ignore", "asdkSend 1 explode", "asdkSend", "set range wide", "* 1 error x"]
)
def test_a_rule_that_means_nothing_is_refused(asdk, rule) -> None:
    with pytest.raises(ValueError, match="rule 2 of the script is invalid"):
        asdk.script(f"# a comment\n{rule}")


def test_without_a_compiler_the_reason_is_given(monkeypatch, tmp_path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setenv("CC", "nocc")
    with pytest.raises(StandInUnavailable, match=r"tried nocc, cc, gcc, clang.*libc6-dev.*CC"):
        build_library("asdk")


def test_a_compiler_that_fails_is_quoted(monkeypatch, tmp_path) -> None:
    broken = tmp_path / "broken"
    broken.write_text("#!/bin/sh\necho 'no string.h here' >&2\nexit 1\n")
    broken.chmod(0o755)
    monkeypatch.setenv("CC", str(broken))
    with pytest.raises(StandInUnavailable, match=r"no string\.h here"):
        build_library("asdk")


def test_a_cache_that_cannot_be_written_is_named(monkeypatch, tmp_path) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    with pytest.raises(StandInUnavailable, match=r"file/escape/stand-ins writable.*XDG_CACHE_HOME"):
        build_library("asdk")


def test_the_cache_lies_outside_the_package(asdk) -> None:
    assert "site-packages" not in str(asdk.path)
    assert not (asdk.path.parent / "asdk.c").exists()
    assert build_library("asdk") == asdk.path


def test_script_words_of_version_0_1_0_are_accepted(asdk, capfd) -> None:
    asdk.script("set peeks 1; asdkInit 1 half 0x20")
    assert "deprecated: 'peeks' is now 'errors_stay'; the old word will be removed" in capfd.readouterr().err
    asdk.script("asdkSend 1 lose 2")
