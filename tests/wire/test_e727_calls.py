"""Commands of the driver to the controller: order, units, values."""

from __future__ import annotations

import math
import time

import numpy as np
import pytest
from usb_bus import pulses_s

from escape_drivers.pi.modulator import PiModulator
from escape_hw.api.emulator import EmulatorRequest
from escape_hw.api.modulator import Modulation
from escape_hw.config.loader import load_system
from escape_hw.config.registry import DeviceContext
from escape_hw.errors import DeviceError, DeviceLost, SettingRejected
from escape_sim.emulators.e727.emulator import E727Emulator, make_emulator

URAD = 1e-6
#: 3 lambda/D of the bundled system, and the frequency of 66 servo periods.
CIRCLE = Modulation(141 * URAD, 303.03)


@pytest.fixture
def emulator():
    options = {"serial": "SIMMOD", "auto-zero": "0.02"}
    with make_emulator(EmulatorRequest(port=0, options=options)) as running:
        yield running


def driver(emulator: E727Emulator, *overrides: str) -> PiModulator:
    wire = ['devices.modulator.wire.host="127.0.0.1"', f"devices.modulator.wire.port={emulator.server.port}"]
    config = load_system("razor-pywfs", overrides=[*wire, *overrides])
    return PiModulator.from_section(config.devices.modulator, DeviceContext("stage", config))


def said(emulator: E727Emulator, since: int = 0) -> list[str]:
    """Commands that set something, in order; ``ERR?`` stands for itself."""
    everything = emulator.controller.received_commands[since:]
    questions = [line for line in everything if line.partition(" ")[0].endswith("?") or line == "#9"]
    return [line for line in everything if line not in questions or line == "ERR?"]


def confirmed(*commands: str) -> list[str]:
    return [word for command in commands for word in (command, "ERR?")]


def without_polls(lines: list[str]) -> list[str]:
    """While it waits for auto-zero the driver asks for errors again and again."""
    return [line for k, line in enumerate(lines) if not (line == "ERR?" and k and lines[k - 1] == "ERR?")]


def test_opening_goes_in_the_order_of_the_manual(emulator):
    with driver(emulator) as stage:
        assert without_polls(said(emulator)) == ["ERR?", *confirmed(
            "TWC", "SVO 1 0 2 0", "ATZ 1 NaN", "ATZ 2 NaN", "SVA 1 0 2 0", "SVO 1 1 2 1", "MOV 1 1000 2 1000",
        )]  # fmt: skip
        assert stage.info.serial == "SIMMOD"
        assert stage.info.max_tilt_rad == pytest.approx(1e-3)
        assert stage.modulation is None
        before = len(emulator.controller.received_commands)
    closing = ["ERR?", *confirmed("TWC", "MOV 1 1000 2 1000", "SVO 1 0 2 0", "SVA 1 0 2 0")]
    assert said(emulator, before) == closing
    assert emulator.violations == ()


def test_a_zeroed_stage_with_servos_on_is_only_centred(emulator):
    stage = driver(emulator)
    with stage:
        stage.modulate(CIRCLE)
        assert stage.release()
    before = len(emulator.controller.received_commands)
    with driver(emulator):
        assert said(emulator, before) == ["ERR?", *confirmed("WGO 1 0 2 0", "TWC", "MOV 1 1000 2 1000")]


def test_a_circle_is_written_started_at_once_and_triggered(emulator):
    with driver(emulator, 'devices.modulator.stage.correction_source="none"') as stage:
        before = len(emulator.controller.received_commands)
        assert stage.modulate(CIRCLE) == Modulation(141 * URAD, 1 / (66 * 50e-6))
        lines = said(emulator, before)
        waves, rest = lines[3:15], lines[15:]
        assert lines[:3] == ["ERR?", *confirmed("TWC")]
        assert waves[1::2] == ["ERR?"] * 6
        for table, begin in ((1, waves[0]), (2, waves[6])):
            assert begin.startswith(f"WAV {table} X PNT 1 27 ")
        for table, first in ((1, 0), (2, 6)):
            bunches = [waves[first + k].split() for k in (0, 2, 4)]
            assert [bunch[:6] for bunch in bunches] == [
                ["WAV", str(table), how, "PNT", "1", str(n)] for how, n in (("X", 27), ("&", 27), ("&", 12))
            ]
            points = np.array([float(word) for bunch in bunches for word in bunch[6:]])
            angle = 2 * np.pi * np.arange(66) / 66
            unit = np.cos(angle) if table == 1 else np.sin(angle)
            # Radius 3/2 lambda/D of mirror tilt, peak to peak twice that, about the centre of 2 mrad.
            assert points == pytest.approx(1000 + 141 * unit, abs=1e-6)
        assert rest == confirmed(
            "WSL 1 1 2 2", "WGC 1 0 2 0", "WOS 1 0 2 0", "WTR 1 1 0 2 1 0", "MOV 1 1141 2 1000",
            "TWC", "TWS 1 1 1", "TWS 1 34 0", "CTO 1 3 4", "WGO 1 1 2 1",
        )  # fmt: skip
        assert pulses_s(emulator.controller, 1, "1") == pytest.approx([0.0])
        stage.park()
        assert emulator.controller.state.describe() == "servo on"
    assert emulator.violations == ()


def test_the_recorder_makes_the_circle_round(emulator):
    with driver(emulator) as stage:
        stage.modulate(CIRCLE)
        recording = [
            line for line in emulator.controller.received_commands if line[:3] in ("DRC", "RTR", "WGR", "DRR")
        ]
        assert recording[:7] == ["DRC 1 1 2", "DRC 2 2 2", "DRC 3 1 1", "DRC 4 2 1", "RTR 2", "WGR",
                                 "DRR? 1 132 1 2 3 4"]  # fmt: skip
        turned = emulator.controller.steady_cycle()
        assert turned is not None
        radii = np.hypot(*(turned[1] - 1000.0).T)
        assert radii == pytest.approx(np.full(256, 141.0), rel=5e-3)
        row = stage.status().details["corrections"][0]
    # The closed loops' response at this frequency, from their own formula.
    for k, (f0, damping) in enumerate(((900.0, 0.75), (750.0, 0.8))):
        s = 1j * row[0] / f0
        known = 1 / (s**2 + 2 * damping * s + 1)
        assert row[1 + k] == pytest.approx(abs(known), rel=2e-3)
        # The hold between servo periods makes it half a period later.
        lag = -math.degrees(np.angle(known)) + 360 * row[0] * 25e-6
        assert row[3 + k] == pytest.approx(lag, abs=0.5)


def test_slow_circles_are_drawn_by_the_controller(emulator):
    with driver(emulator, 'devices.modulator.stage.correction_source="none"') as stage:
        execute = stage.modulate(Modulation(100 * URAD, 0.5, (5 * URAD, -5 * URAD)))
        assert "WAV 1 X SIN_P 4000 200 905 4000 2000 2000" in emulator.controller.received_commands
        assert "WAV 2 X SIN_P 4000 200 895 4000 3000 2000" in emulator.controller.received_commands
        assert "WTR 1 10 1 2 10 1" in emulator.controller.received_commands
        assert execute.frequency_hz == pytest.approx(0.5)
    assert emulator.violations == ()


def test_a_table_of_corrections_is_used_and_has_to_fit(emulator):
    keys = (
        'devices.modulator.stage.correction_source="table"',
        "devices.modulator.stage.corrections=[[303.0,0.5,0.25,0.0,90.0]]",
    )
    with driver(emulator, *keys) as stage:
        with pytest.raises(SettingRejected, match=r"frequency_hz is 500, .* rows for 303 Hz only"):
            stage.check(Modulation(100 * URAD, 500.0))
        stage.modulate(Modulation(100 * URAD, 303.03))
        angle = 2 * np.pi * np.arange(66) / 66
        # Half the amplitude takes twice the drive; a lag of a quarter turn takes a quarter turn of lead.
        assert emulator.controller.waves.tables[1] == pytest.approx(1000 + 200 * np.cos(angle))
        assert emulator.controller.waves.tables[2] == pytest.approx(1000 + 400 * np.cos(angle))
        assert "WGR" not in emulator.controller.received_commands


def test_auto_zero_may_be_forbidden(emulator, caplog):
    with driver(emulator, 'devices.modulator.stage.auto_zero="never"'):
        assert "servos on without auto-zero" in caplog.text
        assert "ATZ 1 NaN" not in emulator.controller.received_commands
    assert all("before auto-zero" in violation for violation in emulator.violations)


def test_axes_may_be_crossed_reversed_and_weak(emulator):
    keys = ('devices.modulator.stage.axes=["2","1"]', "devices.modulator.stage.axis_gain=[-1.0,0.5]")
    with driver(emulator, *keys, 'devices.modulator.stage.correction_source="none"') as stage:
        stage.modulate(Modulation(100 * URAD, 500.0))
        tables = emulator.controller.waves.tables
        angle = 2 * np.pi * np.arange(40) / 40
        assert "WSL 2 1 1 2" in emulator.controller.received_commands
        assert tables[1] == pytest.approx(1000 - 100 * np.cos(angle))
        assert tables[2] == pytest.approx(1000 + 200 * np.sin(angle))


def test_status_of_a_closed_stage_moves_nothing(emulator):
    stage = driver(emulator)
    status = stage.status()
    assert said(emulator) == ["ERR?"]
    assert not stage.is_open
    assert status.modulation is None
    with stage:
        stage.modulate(CIRCLE)
        stage.release()
    before = len(emulator.controller.received_commands)
    found = driver(emulator).status().modulation
    assert {line.split()[0] for line in said(emulator, before)} <= {"ERR?", "DRC", "RTR", "WGR"}
    assert found is not None
    assert found.radius_rad == pytest.approx(141 * URAD, rel=5e-3)
    assert found.frequency_hz == pytest.approx(303.03, rel=1e-4)


def test_a_stop_by_another_client_is_noticed(emulator):
    with driver(emulator) as stage:
        stage.modulate(CIRCLE)
        emulator.controller.execute("\x18")
        assert stage.modulation is None


@pytest.mark.parametrize(
    ("override", "says"),
    [
        ('devices.modulator.serial="42"', r"found the controller with serial number 'SIMMOD', not '42'"),
        ('devices.modulator.stage.axes=["1","4"]', r"has no axis '4', only 1, 2;"),
        ('devices.modulator.stage.axes=["1","3"]', r"has no axis '3', only 1, 2;"),
    ],
)
def test_the_wrong_controller_is_left_alone(emulator, override, says):
    stage = driver(emulator, override)
    with pytest.raises(DeviceError, match=says):
        stage.open()
    assert said(emulator) == ["ERR?"]
    assert not stage.is_open


def test_limits_are_the_controllers_own(emulator):
    with driver(emulator, "devices.modulator.max_tilt_rad=0.05") as stage:
        assert stage.info.max_tilt_rad == pytest.approx(1e-3)
        with pytest.raises(SettingRejected, match=r"the range is 0 to 0\.001 rad"):
            stage.check(Modulation(1.1e-3, 300.0))
        with pytest.raises(SettingRejected, match=r"it does up to 1000 Hz"):
            stage.check(Modulation(1e-4, 1500.0))


def test_auto_zero_that_fails_is_reported(emulator):
    emulator.controller.state.axes["2"].zero_failed = True
    with pytest.raises(
        DeviceError, match=r"refused 'ATZ 2': error 98, auto-zero failed; is the platform free"
    ):
        driver(emulator).open()
    assert emulator.controller.state.describe() == "at rest"


def test_auto_zero_that_never_ends_is_given_up():
    options = {"serial": "SIMMOD", "auto-zero": "100"}
    with make_emulator(EmulatorRequest(port=0, options=options)) as slow:
        began = time.monotonic()
        stage = driver(slow, "devices.modulator.stage.auto_zero_s=0.2")
        with pytest.raises(
            DeviceError, match=r"auto-zero of axis 1 has not ended after 0\.2 s; is the platform"
        ):
            stage.open()
        assert time.monotonic() - began < 20


def test_ctrl_c_during_auto_zero_stops_the_sweep(emulator):
    def pressed(seconds: float) -> None:
        raise KeyboardInterrupt

    stage = driver(emulator)
    stage._sleep = pressed
    with pytest.raises(KeyboardInterrupt):
        stage.open()
    assert said(emulator)[-6:] == confirmed("STP", "SVO 1 0 2 0", "SVA 1 0 2 0")
    assert emulator.controller.state.describe() == "at rest"
    assert not emulator.controller.state.is_zeroing("1")
    assert not stage.is_open


def test_a_second_client_is_refused_with_a_reason(emulator):
    with driver(emulator), pytest.raises(DeviceLost, match=r"one at a time"):
        driver(emulator).open()
    assert emulator.violations == (
        "second client from 127.0.0.1 refused: the controller serves one at a time",
    )
