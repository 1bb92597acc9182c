"""The emulated E-727 is strict: it follows its manual, and reports violations."""

from __future__ import annotations

import numpy as np
import pytest
from usb_bus import UsbPipe, pulses_s

from escape_hw.api.emulator import EmulatorRequest
from escape_hw.errors import ConfigError
from escape_sim.emulators.e727 import controller as e727
from escape_sim.emulators.e727 import gcs as gcs_syntax
from escape_sim.emulators.e727.controller import E727Controller
from escape_sim.emulators.e727.emulator import make_emulator
from escape_sim.emulators.e727.stage import SERVO_S
from escape_sim.emulators.e727.state import ControllerSettings
from escape_sim.emulators.e727.transports import FaultInjector, parse_fault
from escape_sim.emulators.options import parse_fault_script


class Client:
    """A client that says anything at all, on a clock of its own."""

    def __init__(self, *, zeroed: bool = True) -> None:
        self.time = 0.0
        self.controller = E727Controller(
            ControllerSettings(zeroed=zeroed, auto_zero_s=1.0), lambda: self.time
        )

    def say(self, text: str) -> str:
        answers = [self.controller.execute(line) for line in self.controller.receive(text.encode() + b"\n")]
        return b"".join(answers).decode("cp1252")

    def error(self, text: str) -> int:
        """The error that a command leaves."""
        self.say(text)
        return int(self.say("ERR?"))

    def wait(self, seconds: float) -> None:
        self.time += seconds

    def values(self, question: str) -> list[float]:
        return [float(line.partition("=")[2]) for line in self.say(question).splitlines()]

    def table(self, question: str) -> np.ndarray:
        rows = self.say(question).splitlines()
        return np.array([[float(word) for word in row.split()] for row in rows if not row.startswith("#")])

    @property
    def violations(self) -> list[str]:
        return self.controller.state.violations


@pytest.fixture
def client() -> Client:
    return Client()


@pytest.fixture
def servo(client: Client) -> Client:
    assert client.error("SVO 1 1 2 1") == 0
    return client


#: what is said, the error of the manual
WRONG = [
    ("FOO", 2), ("MOV 1", 24), ("MOV", 26), ("MOV 1 x", 25), ("MOV 1 nan", 25), ("MOV 4 1", 15),
    ("MOV 3 1", 15), ("MOV 1 5 1 6", 22), ("MOV 1 5000", 7), ("MOV 1 -1", 7), ("SVA 1 5", 79),
    ("ATZ 1 NaN", 79), ("SVO 1 2", 17), ("VEL 1 0", 8), ("SPA 1 0x07000000 5", 60), ("CCL 1 wrong", 56),
    ("WPA wrong", 56), ("WAV 999 X PNT 1 1 5", 400), ("WAV 1 & PNT 1 1 5", 401), ("WAV 1 X RAMP 5 5", 402),
    ("WAV 1 X PNT 1 2 5", 404), ("WAV 1 X SIN_P 40 9 0 80 0 20", 403),
    ("WAV 1 X SIN_P 40 9 0 40 0 40", 405), ("WAV 1 X SIN_P 300000 9 0 9 0 4", 67), ("WSL 1 7", 401),
    ("WGO 1 1", 75), ("WGO 1 2", 406), ("WTR 0 0 0", 17), ("DRC 9 1 2", 57), ("DRC 1 7 2", 58),
    ("DRC 1 1 9", 59), ("DRT 0 2 0", 59), ("HLT", 10), ("STP", 10), ("\x18", 10), ("#24", 2), ("#", 2),
    ("MOV " + "1 2 " * 20, 24),
]  # fmt: skip


@pytest.mark.parametrize(("command", "error"), WRONG)
def test_what_is_wrong_leaves_the_error_of_the_manual(servo, command, error):
    assert servo.error(command) == error
    assert servo.say("ERR?") == "0\n", "asking clears the error"
    assert bool(servo.violations) == (error != 10), "only stopping is no mistake"


def test_the_servo_comes_first_and_volts_only_without_it(client):
    assert client.error("MOV 1 100") == 5
    assert client.error("SVA 1 200") == 66
    assert client.error("SVA 1 10") == 0
    assert client.say("SVA? 1") == "1=1.000000000e+01\n"


def test_a_servo_before_auto_zero_is_a_violation():
    client = Client(zeroed=False)
    assert client.say("ATZ?") == "1=0 \n2=0\n"
    assert client.error("SVO 1 1") == 0
    assert client.violations == ["SVO 1 1 before auto-zero: the sensor has an unknown offset"]


def test_auto_zero_takes_its_time_and_the_full_range():
    client = Client(zeroed=False)
    assert client.error("ATZ 1 NaN") == 0
    seen = []
    for _ in range(30):
        client.wait(0.033)
        seen.append(client.values("POS? 1")[0])
    assert client.say("\x07") == "\xb0\n"
    assert client.error("SVO 1 1") == 61
    assert max(seen) > 1900
    client.wait(0.1)
    assert client.say("\x07") == "\xb1\n"
    assert client.say("ATZ? 1") == "1=1\n"


def test_a_failed_auto_zero_is_reported():
    client = Client(zeroed=False)
    client.controller.state.axes["1"].zero_failed = True
    assert client.error("ATZ 1 NaN") == 0
    client.wait(1.1)
    assert client.say("ATZ? 1") == "1=0\n"
    assert client.say("ERR?") == "98\n"


def test_errors_have_to_be_requested(client):
    client.say("SVO 1 1")
    client.say("SVO 2 1")
    assert client.violations == ["no ERR? after 'SVO 1 1' (then: 'SVO 2 1')"]
    client.controller.end_session()
    assert client.violations[1:] == ["no ERR? after 'SVO 2 1' (then: 'disconnected')"]


def test_moves_keep_to_the_velocity_and_the_range(servo):
    assert servo.error("VEL 1 1000") == 0
    assert servo.error("MOV 1 500") == 0
    servo.wait(0.25)
    assert servo.values("POS? 1")[0] == pytest.approx(250.0, abs=1.0)
    assert (servo.say("ONT? 1"), servo.values("MOV? 1")) == ("1=0\n", [500.0])
    servo.wait(0.3)
    assert servo.say("ONT? 1") == "1=1\n"
    assert servo.error("CCL 1 advanced") == 0
    assert servo.error("SPA 1 0x07000001 600") == 0
    assert servo.say("TMX? 1") == "1=6.000000000e+02\n"
    assert servo.error("MOV 1 700") == 7


def circle(client: Client, points: int = 40, *, extra: str = "") -> None:
    """Tables 1 and 2 make a circle of 100 urad about 1000."""
    for table, start in ((1, 0), (2, points // 4)):
        assert client.error(f"WAV {table} X SIN_P {points} 200 900 {points} {start} {points // 2}") == 0
    for command in ("WSL 1 1 2 2", "WGC 1 0 2 0", "MOV 1 900 2 1000", *filter(None, [extra])):
        assert client.error(command) == 0
    client.wait(0.1)


def test_a_stage_follows_as_its_second_order_says(servo):
    circle(servo)
    assert servo.error("WGO 1 1 2 1") == 0
    assert servo.violations == []
    servo.wait(0.3)
    for command in ("DRC 1 1 2 2 2 2 3 1 1", "RTR 1", "WGR"):
        assert servo.error(command) == 0
    servo.wait(0.1)
    track = servo.table("DRR? 1 400 1 2 3")
    angle = np.exp(-2j * np.pi * np.arange(400) / 40)
    x, y, target = (2 / 400 * (column - 1000) @ angle for column in track.T)
    assert abs(target) == pytest.approx(100.0, rel=1e-6)
    # 500 Hz; the closed loop is held for a servo period, which makes it half a period later.
    for found, lag, (f0, damping) in ((x, 0, (900.0, 0.75)), (y, 90, (750.0, 0.8))):
        s = 1j * 500 / f0
        ideal = 1 / (s**2 + 2 * damping * s + 1) * np.exp(-1j * np.pi * 500 * SERVO_S)
        there = found / target * np.exp(1j * np.radians(lag))
        assert there == pytest.approx(ideal, rel=5e-3)


def test_one_line_starts_both_axes_in_one_cycle_and_two_do_not(servo):
    circle(servo)
    assert servo.error("WGO 1 1 2 1") == 0
    axes = servo.controller.state.stage.axes
    assert axes["1"].trajectory.start == axes["2"].trajectory.start
    assert servo.error("WGO 1 0 2 0") == 0
    servo.wait(0.1)
    assert servo.error("MOV 1 900 2 1000") == 0
    servo.wait(0.1)
    assert servo.error("WGO 1 1") == 0
    servo.wait(0.01)
    assert servo.error("WGO 2 1") == 0
    assert servo.violations == ["WGO 2 starts while 1 runs: their phase is undefined"]


def test_a_start_far_from_the_first_point_is_a_jump(servo):
    circle(servo, extra="MOV 1 500 2 1000")
    assert servo.error("WGO 1 1 2 1") == 0
    assert servo.violations == ["WGO 1 starts with a jump of 400.0 urad; MOV there first"]


def test_a_turning_axis_accepts_no_other_commands(servo):
    circle(servo)
    assert servo.error("WGO 1 1 2 1") == 0
    for command in ("MOV 1 1000", "SVO 1 0", "WSL 1 2", "WAV 1 X PNT 1 1 5", "WCL 1", "WGO 1 1"):
        assert servo.error(command) == 73
    assert servo.say("\x09") == "3\n"
    assert servo.say("WGO?") == "1=0x1 \n2=0x1\n"
    assert servo.error("WGO 1 0 2 0") == 0
    assert servo.say("\x09") == "0\n"


def test_a_wave_beyond_the_travel_does_not_start(servo):
    assert servo.error("WAV 1 X PNT 1 2 1900 2100") == 0
    assert servo.error("WSL 1 1") == 0
    assert servo.error("WGO 1 1") == 405


def test_waves_are_quantised_by_the_clock_and_the_rate(servo):
    circle(servo, points=40, extra="WTR 0 3 0")
    assert servo.error("WGO 1 1 2 1") == 0
    turned = servo.controller.steady_cycle()
    assert turned is not None
    assert turned[0] == pytest.approx(40 * 3 * 50e-6)
    assert servo.controller.steady_cycle() is turned, "nothing has changed"


def test_so_many_cycles_and_no_more(servo):
    circle(servo, extra="WGC 1 2 2 2")
    assert servo.error("WGO 1 1 2 1") == 0
    servo.wait(1.9 * 40 * 50e-6)
    assert servo.say("\x09") == "3\n"
    servo.wait(0.2 * 40 * 50e-6)
    assert servo.say("\x09") == "0\n"


def test_pulses_come_where_the_trigger_says(servo):
    circle(servo)
    for command in ("TWC", "TWS 1 11 1", "TWS 1 31 0", "CTO 1 3 4"):
        assert servo.error(command) == 0
    assert pulses_s(servo.controller, 1, "1").size == 0, "no wave, no pulse"
    assert servo.error("WGO 1 1 2 1") == 0
    assert pulses_s(servo.controller, 1, "1") == pytest.approx([10 * 50e-6])
    assert pulses_s(servo.controller, 2, "1").size == 0
    assert servo.error("CTO 1 3 0") == 0
    assert pulses_s(servo.controller, 1, "1").size == 0


def test_replies_have_the_manuals_form(servo):
    assert servo.say("POS?") == "1=0.000000000e+00 \n2=0.000000000e+00\n"
    assert servo.say("SAI?") == "1 \n2\n"
    assert servo.say("SAI? ALL") == "1 \n2 \n3\n"
    assert servo.say("CST? 3") == "3=NOSTAGE\n"
    assert servo.say("spa? 1 0x0E000200") == "1 0xE000200=5.000000000e-05\n"
    assert servo.error("WAV 1 X PNT 1 2 5 6") == 0
    assert servo.say("GWD? 1 2 1").endswith("# END_HEADER \n5.000000 \n6.000000\n")


def test_a_reset_forgets_all_but_auto_zero_and_a_power_cut_that_too(servo):
    circle(servo)
    servo.say("RBT")
    assert servo.say("SVO?") == "1=0 \n2=0\n"
    assert servo.say("ATZ?") == "1=1 \n2=1\n"
    assert servo.error("WSL 1 1") == 401
    servo.controller.reset(power_cut=True)
    assert servo.say("ATZ?") == "1=0 \n2=0\n"


def test_usb_transfers_are_even():
    pipe = UsbPipe(E727Controller(), FaultInjector())
    pipe.write(b"ERR?\n\0")
    assert pipe.read(64, 0.0) == b"0\n"
    pipe.write(b"ERR?\n")
    (violation,) = pipe._controller.state.violations
    assert "pad it to an even number" in violation


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"colour": "red"}, "--option colour: unknown; this emulator has serial, auto-zero, zeroed, fault"),
        ({"auto-zero": "soon"}, "auto-zero=soon: must be a valid number"),
        ({"auto-zero": "-1"}, "auto-zero=-1: must be greater than 0"),
        ({"zeroed": "yes"}, "zeroed=yes: must be '0' or '1'"),
        ({"fault": "close"}, "fault 'close': write KIND@NUMBER"),
        ({"fault": "melt@3"}, "KIND one of drop_command, drop_reply"),
    ],
)
def test_wrong_options_are_refused(options, says):
    with pytest.raises(ConfigError, match=says):
        make_emulator(EmulatorRequest(port=0, options=options))


def test_a_port_in_use_is_reported():
    with make_emulator(EmulatorRequest(port=0)) as first:
        second = make_emulator(EmulatorRequest(port=first.server.port))
        with pytest.raises(ConfigError, match="choose another --port"):
            second.start()


def test_faults_are_read_from_text():
    assert parse_fault_script("drop_reply@12,close@40", parse_fault) == {12: "drop_reply", 40: "close"}


def test_fault_words_of_version_0_1_0_are_accepted(capsys):
    assert parse_fault_script("lose@1,drop@2,late@3,power@4", parse_fault) == {
        1: "drop_command", 2: "drop_reply", 3: "delay", 4: "power_cut",
    }  # fmt: skip
    assert capsys.readouterr().err.splitlines()[0] == (
        "deprecated: 'lose' is now 'drop_command'; the old word will be removed"
    )
    assert gcs_syntax.ERRORS[73] == "wave generator active"


def test_every_axis_that_is_named_answers(servo):
    """As PIPython, which asks every axis that SAI? names."""
    names = servo.say("SAI?").split()
    assert servo.say(f"POS? {' '.join(names)}").count("=") == len(names)
    assert servo.say("ERR?") == "0\n"


def test_the_record_of_commands_is_bounded(monkeypatch):
    monkeypatch.setattr(e727, "MAX_COMMANDS", 2)
    client = Client()
    for text in ("SVO?", "VER?", "CSV?"):
        client.say(text)
    assert client.controller.received_commands == ("VER?", "CSV?")
    assert client.controller.report()["commands"] == 3
