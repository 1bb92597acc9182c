"""``escape modulator``: on the twin, and over the wire on the emulator."""

from __future__ import annotations

import shlex

import pytest

from escape_hw.api.emulator import EmulatorRequest
from escape_sim.emulators.e727.emulator import make_emulator

HARDWARE = ("--set", "devices.modulator.mode=hardware")


@pytest.fixture
def stage():
    """A controller on the network, and the options that lead to it."""
    with make_emulator(EmulatorRequest(port=0, options={"serial": "SIMMOD", "zeroed": "1"})) as emulator:
        where = (
            "devices.modulator.wire.host=127.0.0.1",
            f"devices.modulator.wire.port={emulator.server.port}",
        )
        yield emulator, (*HARDWARE, *(word for key in where for word in ("--set", key)))


@pytest.mark.parametrize("verb", ["start", "stop", "status"])
def test_the_twin_answers(document, verb):
    code, found, err = document("modulator", verb, "razor-pywfs")
    assert code == 0
    assert found["command"] == f"modulator {verb}"
    assert found["simulated"]
    assert found["info"]["model"] == "simulated PI S-330 with E-727"
    assert found["changed"] == (verb != "status")
    assert "this changes hardware" not in err
    if verb == "start":
        assert found["modulation"]["radius_lambda_d"] == pytest.approx(3.0)
        assert found["left"] == "parked", "a twin ends with the command"


def test_start_status_stop_on_the_wire(document, escape, stage):
    emulator, here = stage
    code, found, err = document("modulator", "start", "razor-pywfs", "--radius", 2, "--frequency", 300, *here)
    assert code == 0, err
    assert "this changes hardware, devices.modulator" in err
    assert ": servos on, auto-zero where needed, centre, then the circle" in err
    assert "requested: 2 lambda/D (94 urad) at 300 Hz" in err
    assert "achievable: 2 lambda/D (94 urad) at 298.507 Hz" in err
    assert found["asked"] == {"radius_lambda_d": 2.0, "frequency_hz": 300.0}
    assert found["foreseen"]["frequency_hz"] == pytest.approx(1 / (67 * 50e-6))
    assert found["modulation"]["radius_lambda_d"] == pytest.approx(2.0)
    assert found["details"]["circle_error"] < 0.02
    assert found["left"] == "turning"
    assert emulator.controller.state.describe() == "turning"

    code, found, err = document("modulator", "status", "razor-pywfs", *here)
    assert code == 0
    assert "this changes hardware" not in err
    assert found["modulation"]["radius_lambda_d"] == pytest.approx(2.0, rel=0.01)
    assert emulator.controller.state.describe() == "turning"
    code, out, _ = escape("modulator", "status", "razor-pywfs", *here)
    assert "modulating: 2 lambda/D" in out or "modulating: 1.99" in out or "modulating: 2.00" in out

    code, found, err = document("modulator", "stop", "razor-pywfs", *here)
    assert code == 0
    assert "this changes hardware, devices.modulator" in err
    assert ": centre, servos off" in err
    assert (found["modulation"], found["left"]) == (None, "parked")
    assert emulator.controller.state.describe() == "at rest"
    assert emulator.violations == ()


def test_a_stage_without_a_system_is_stopped_by_the_command_that_is_printed(escape, document, stage):
    emulator, _ = stage
    words = ["--driver", "pi-e727", "--serial", "SIMMOD", "--set", "host=127.0.0.1"]
    words += ["--set", f"port={emulator.server.port}", "--set", "stage.axes=['1', '2']"]
    circle = ["--radius-rad", 1.4e-4, "--frequency", 303.0]
    code, _, err = escape("modulator", "start", *words[:2], *words[4:], *circle)
    assert (code, "needs serial, which is missing" in err, "--serial NUMBER" in err) == (2, True, True)
    assert emulator.controller.state.describe() == "at rest"
    code, out, err = escape("modulator", "start", *words, *circle)
    assert code == 0, err
    assert "this changes hardware, pi-e727 SIMMOD: servos on" in err
    assert emulator.controller.state.describe() == "turning"
    printed = shlex.split(out.partition("stop it with: ")[2].splitlines()[0])
    assert printed == ["escape", "modulator", "stop", *words]
    code, found, _ = document(*printed[1:])
    assert (code, found["driver"], found["serial"], found["left"]) == (0, "pi-e727", "SIMMOD", "parked")
    assert emulator.controller.state.describe() == "at rest"


def test_a_stage_of_a_system_is_stopped_by_the_command_that_is_printed(escape, stage):
    emulator, here = stage
    code, out, err = escape("modulator", "start", "razor-pywfs", *here)
    assert code == 0, err
    printed = shlex.split(out.partition("stop it with: ")[2].splitlines()[0])
    assert printed == ["escape", "modulator", "stop", "razor-pywfs", *here]
    assert escape(*printed[1:])[0] == 0
    assert emulator.controller.state.describe() == "at rest"


def test_for_some_seconds_and_then_parked(document, stage):
    emulator, here = stage
    code, found, _ = document("modulator", "start", "razor-pywfs", "--seconds", 0.05, *here)
    assert (code, found["left"]) == (0, "parked")
    assert found["modulation"] is not None
    assert emulator.controller.state.describe() == "at rest"


def test_what_it_cannot_do_is_refused_before_it_turns(document, stage):
    emulator, here = stage
    code, found, err = document("modulator", "start", "razor-pywfs", "--frequency", 4000, *here)
    assert code == 3
    assert found["error"]["type"] == "SettingRejected"
    assert "frequency_hz is 4000" in err
    assert not [line for line in emulator.controller.received_commands if line.startswith("WGO ")]
    assert emulator.controller.state.describe() == "at rest"


def test_a_controller_in_use_is_reported(document, stage):
    from escape_drivers.pi.transports import TcpTransport

    emulator, here = stage
    other = TcpTransport("127.0.0.1", emulator.server.port, 1.0, 1.0)
    other.open()
    try:
        code, _, err = document("modulator", "status", "razor-pywfs", *here)
    finally:
        other.close()
    assert code == 3
    assert "one at a time" in err or "one client at a time" in err


def test_a_system_without_one_is_reported(document):
    code, _, err = document("modulator", "status", "razor-shwfs")
    assert code == 2
    assert "has no modulator" in err
    code, _, err = document("modulator", "status", "razor-pywfs", "--set", "devices.modulator.sim_driver=''")
    assert code == 2
