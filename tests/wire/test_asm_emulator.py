"""The emulated adaptive secondary is strict: violations of a client are refused and recorded."""

from __future__ import annotations

import struct
import time
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from asm_bench import RawClient, command, emulator, frame, hello, port_of, wait_for
from hypothesis import given, settings
from hypothesis import strategies as st

from escape_hw.api.adaptive_secondary import STATE_ORDER, ShellState
from escape_hw.api.emulator import EmulatorRequest
from escape_hw.config.registry import emulator_factory
from escape_hw.errors import ConfigError
from escape_sim.emulators.asm import protocol as w
from escape_sim.emulators.asm import server as asm_server
from escape_sim.emulators.asm.emulator import AsmEmulator
from escape_sim.emulators.asm.server import AsmConnection


def refusal(payload: bytes) -> tuple[int, str]:
    """Code and text of a NAK."""
    return struct.unpack_from("<H", payload, 4)[0], w.read_text(payload[8:])


def running(client: RawClient) -> int:
    """Introduce a client and lead the mirror to running; returns the last sequence number."""
    client.send(hello(1))
    client.reply(w.WELCOME)
    sequence = 1
    for state in (1, 2, 3):
        sequence += 1
        client.send(frame(w.SET_STATE, sequence, bytes([state])))
        client.reply(w.DONE)
        while True:
            sequence += 1
            client.send(frame(w.HEARTBEAT, sequence))
            if client.reply(w.ACK)[6] == state:
                break
    return sequence


# --------------------------------------------------------------------- an obliging driver is caught
@pytest.mark.parametrize(
    ("request_", "code", "words"),
    [
        (frame(w.HEARTBEAT, 1), w.NOT_OWNER, "HEARTBEAT before HELLO"),
        (hello(1, role=7), w.UNSUPPORTED, "no role 7"),
        (hello(1, versions=(2, 9)), w.UNSUPPORTED, "versions 1 to 1"),
        (frame(w.HELLO, 1, b"\x01"), w.BAD_LENGTH, "HELLO is malformed"),
    ],
    ids=["no hello", "role", "versions", "short hello"],  # the bytes hold the time
)
def test_a_bad_beginning_is_refused(request_: bytes, code: int, words: str) -> None:
    with emulator() as made, RawClient(port_of(made)) as client:
        client.send(request_)
        found, text = refusal(client.reply(w.NAK))
        assert found == code
        assert words in text
        assert any(words in violation for violation in made.violations)


@pytest.mark.parametrize(
    ("kind", "payload", "code", "words"),
    [
        (w.SET_STATE, bytes([3]), w.WRONG_STATE, "no transition from off to running"),
        (w.SET_STATE, bytes([9]), w.BAD_LENGTH, "SET_STATE is malformed"),
        (w.SET_STATE, b"", w.BAD_LENGTH, "SET_STATE is malformed"),
        (w.HELLO, hello()[28:-4], w.WRONG_STATE, "HELLO for the second time"),
        (w.SET_DISABLED, b"\xff\xff\x00", w.BAD_LENGTH, "SET_DISABLED is malformed"),
        (w.SET_DISABLED, struct.pack("<H", 50) + b"\xff" * 50 + b"\0\0", w.BAD_LENGTH, "no actuator 399"),
        (w.GET_PARAM, b"\x01\x00x", w.BAD_LENGTH, "no parameter 'x'"),
        (33, b"", w.UNSUPPORTED, "type 33 is unknown"),
        (w.COMMAND, struct.pack("<IBxxx", 1, 1) + bytes(4 * 97), w.BAD_LENGTH, "bytes of command"),
        (w.COMMAND, struct.pack("<IBxxx", 1, 1) + bytes(4 * 336), w.WRONG_STATE, "it is off"),
    ],
)
def test_a_request_out_of_order_or_form_is_refused(kind: int, payload: bytes, code: int, words: str) -> None:
    with emulator() as made, RawClient(port_of(made)) as client:
        client.send(hello(1))
        client.reply(w.WELCOME)
        client.send(frame(kind, 2, payload))
        found, text = refusal(client.reply(w.NAK))
        assert found == code
        assert words in text
        assert any(words in violation for violation in made.violations)


def test_commands_that_are_not_fresh_finite_and_alone_are_refused() -> None:
    with emulator() as made, RawClient(port_of(made)) as client:
        last = running(client)
        client.send(command(last + 1, 5, 1e-7))
        client.reply(w.ACK)
        for data, words in (
            (command(last + 1, 6), "request"),
            (command(last, 6), "request"),
            (command(last + 2, 5), "command 5 after 5"),
            (command(last + 3, 6, float("nan")), "not finite"),
            (command(last + 4, 7, float("inf")), "not finite"),
        ):
            client.send(data)
            assert words in refusal(client.reply(w.NAK))[1]
        assert made.controller.applied == 1
        assert made.controller.present_m[0] == pytest.approx(1e-7)
        # Several at once: only the newest is applied.
        client.send(command(last + 5, 8, 1e-7) + command(last + 6, 9, 2e-7) + command(last + 7, 10, 3e-7))
        assert "newer" in refusal(client.reply(w.NAK))[1]
        assert "newer" in refusal(client.reply(w.NAK))[1]
        client.reply(w.ACK)
        assert made.controller.applied == 2
        assert made.controller.present_m[0] == pytest.approx(3e-7)
        assert any("did not wait" in violation for violation in made.violations)


def test_a_clock_that_runs_backwards_is_noticed() -> None:
    with emulator() as made, RawClient(port_of(made)) as client:
        client.send(hello(1))
        client.reply(w.WELCOME)
        for sequence, sent_ns in ((2, 10**18), (3, 5)):
            client.send(frame(w.HEARTBEAT, sequence, sent_ns=sent_ns))
            client.reply(w.ACK)
        assert made.violations == ("test's clock runs backwards",)


def test_an_observer_cannot_command() -> None:
    with emulator() as made, RawClient(port_of(made)) as client:
        client.send(hello(1, role=1))
        client.reply(w.WELCOME)
        client.send(frame(w.SET_STATE, 2, bytes([1])))
        assert "from an observer" in refusal(client.reply(w.NAK))[1]
        assert made.controller.shell.state is ShellState.OFF
        assert client.reply(w.TELEM)


def test_a_shell_left_running_is_noticed_and_rested() -> None:
    with emulator(hold_s=0.05, rest_s=0.2) as made:
        with RawClient(port_of(made)) as client:
            running(client)
        wait_for(lambda: made.controller.shell.state is ShellState.RESTED, "the watchdog rests it")
        assert "the owner left the shell running" in made.violations
        assert "watchdog" in made.controller.last_event


def test_limits_of_the_mirror_itself_skip_a_command() -> None:
    with emulator() as made, RawClient(port_of(made)) as client:
        last = running(client)
        for number, (metres, result) in enumerate(
            ((4e-6, w.APPLIED), (8e-6, w.APPLIED), (8.1e-6, w.SKIPPED), (2e-6, w.SKIPPED), (5e-6, w.APPLIED)),
            1,
        ):
            client.send(command(last + number, number, metres))
            found = struct.unpack_from("<H", client.reply(w.ACK), 4)[0]
            # Actuators out of service are among those that move here.
            assert (found == w.SKIPPED) == (result == w.SKIPPED)
        assert made.controller.skipped == 2


# --------------------------------------------------------------------- whatever comes in whatever pieces
class Wire:
    """A transport that remembers what was written."""

    def __init__(self) -> None:
        self.written, self.ended = bytearray(), False

    def write(self, data: bytes) -> None:
        self.written += data

    def abort(self) -> None:
        self.ended = True

    close = abort

    def is_closing(self) -> bool:
        return self.ended

    def get_extra_info(self, name: str) -> Any:
        return self

    def setsockopt(self, *option: object) -> None:
        """Nothing to set."""


def offline() -> tuple[AsmEmulator, AsmConnection, Wire]:
    """An emulator that runs, and a connection that bytes are put into by hand."""
    made = emulator_factory("asm")(EmulatorRequest(port=0, options={"hold": "100", "rest": "1000"}))
    assert isinstance(made, AsmEmulator)
    for state in STATE_ORDER[1:]:
        made.controller.request_state(state, time.monotonic())
        made.controller.tick(time.monotonic() + 100, 0.0)
    connection, wire = AsmConnection(made.server), Wire()
    connection.connection_made(wire)  # type: ignore[arg-type]
    connection.data_received(hello(1))
    wire.written.clear()
    return made, connection, wire


def in_pieces(connection: AsmConnection, wire: Wire, data: bytes, places: list[int]) -> None:
    marks = [0, *sorted({place % (len(data) + 1) for place in places}), len(data)]
    for a, b in pairwise(marks):
        if not wire.ended:
            connection.data_received(data[a:b])


@settings(deadline=None, max_examples=60)
@given(st.integers(1, 4), st.lists(st.integers(0, 6000), max_size=8))
def test_commands_in_any_fragments_are_applied_once(count: int, places: list[int]) -> None:
    made, connection, wire = offline()
    data = b"".join(command(1 + k, k, k * 1e-7) for k in range(1, count + 1))
    in_pieces(connection, wire, data, places)
    assert made.controller.present_m[0] == pytest.approx(count * 1e-7)
    # Those that came together with a newer one were left out; every one was answered.
    replies = 0
    while w.decode_frame(wire.written) is not None:
        replies += 1
    assert replies == count
    assert 1 <= made.controller.applied <= count


@settings(deadline=None, max_examples=100)
@given(st.integers(0, 2000), st.integers(0, 255), st.booleans(), st.lists(st.integers(0, 2000), max_size=4))
def test_incomplete_commands_are_not_applied(
    where: int, byte: int, cut_short: bool, places: list[int]
) -> None:
    made, connection, wire = offline()
    sound = command(2, 1, 3e-7)
    where %= len(sound)
    data = sound[:where] + (b"" if cut_short else bytes([byte]) + sound[where + 1 :])
    in_pieces(connection, wire, data, places)
    assert made.controller.applied == int(data == sound)
    assert made.controller.present_m.any() == (data == sound)


@settings(deadline=None, max_examples=100)
@given(st.binary(min_size=1, max_size=300), st.lists(st.integers(0, 300), max_size=4))
def test_garbage_is_hung_up_on_and_moves_nothing(garbage: bytes, places: list[int]) -> None:
    made, connection, wire = offline()
    in_pieces(connection, wire, garbage, places)
    assert made.controller.applied == 0
    assert made.controller.shell.state is ShellState.RUNNING
    assert wire.ended or b"ASM1".startswith(garbage[:4])


@settings(deadline=None, max_examples=100)
@given(st.integers(0, 255), st.binary(max_size=100))
def test_sound_frames_with_nonsense_in_them_are_answered(kind: int, payload: bytes) -> None:
    made, connection, wire = offline()
    connection.data_received(frame(kind, 2, payload))
    assert made.controller.applied == 0
    assert w.decode_frame(wire.written) is not None
    connection.data_received(command(3, 1, 1e-7))
    # Whatever it was, the mirror may have been stepped down, no more than that.
    assert made.controller.applied == int(
        made.controller.shell.state is ShellState.RUNNING and made.controller._transition is None
    )


def test_an_observer_that_does_not_read_gets_only_the_newest() -> None:
    made, connection, wire = offline()
    observer, wire = AsmConnection(made.server), Wire()
    observer.connection_made(wire)  # type: ignore[arg-type]
    observer.data_received(hello(1, role=1))
    wire.written.clear()
    observer.pause_writing()
    for _ in range(1000):
        observer.send_unsolicited(w.TELEM, made.server.replies.telemetry())
    assert not wire.written
    observer.resume_writing()
    assert w.decode_frame(wire.written) is not None
    assert not wire.written
    assert connection is made.server.owner


# --------------------------------------------------------------------- options
@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"dusty": "1"}, "--option dusty: unknown"),
        ({"contaminated": "400"}, "numbers of actuators, 0 to 335"),
        ({"fault": "explode@3"}, "write one of"),
        ({"fault": "skip"}, "KIND@NUMBER"),
        ({"fault": "contaminate:x@1"}, "not a number"),
        ({"transition_speed": "0"}, "transition_speed=0: must be greater than 0"),
        ({"versions": "1"}, "versions=1: String should match"),
    ],
)
def test_wrong_options_are_refused(options: dict[str, str], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        emulator_factory("asm")(EmulatorRequest(options=options))


def test_a_port_that_is_taken_is_named() -> None:
    with emulator() as made:
        second = emulator_factory("asm")(EmulatorRequest(port=port_of(made)))
        with pytest.raises(ConfigError, match="cannot listen on 127"):
            second.start()


def test_contaminated_actuators_are_reported_with_what_their_neighbours_do() -> None:
    made, connection, _ = offline()
    connection.data_received(command(2, 1, 4e-7))
    off = sorted(made.controller.out_of_service)
    assert not made.controller.present_m[off].any()
    payload = made.server.replies.telemetry()
    shape = np.frombuffer(payload, "<f4", 336, 16)
    assert shape[off] == pytest.approx(4e-7)
    flags = np.frombuffer(payload, np.uint8, 336, 16 + 3 * 4 * 336)
    assert set(np.flatnonzero(flags & 0b1000)) == set(off)


def test_options_and_faults_of_version_0_1_0_are_accepted(capsys: pytest.CaptureFixture[str]) -> None:
    faults = "dust:3@1,stuck:4@2,calm@3,half@4,silent@5"
    old = {"dust": "17", "speed": "10", "hold": "2", "rest": "4", "fault": faults}
    made = emulator_factory("asm")(EmulatorRequest(options=old))
    assert isinstance(made, AsmEmulator)
    assert 17 in made.controller.contaminated
    assert (made.controller.limits.hold_s, made.controller.limits.rest_s) == (2.0, 4.0)
    kinds = [fault.kind for fault in made.server._faults.values()]
    assert kinds == ["contaminate", "unreadable", "clear", "truncate", "stall"]
    assert "deprecated: 'hold' is now 'hold_s'; the old word will be removed" in capsys.readouterr().err
    assert made.report()["note"] == made.report()["last_event"] == ""


def test_the_record_of_requests_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(asm_server, "MAX_CALLS", 2)
    with emulator() as made, RawClient(port_of(made)) as client:
        client.send(hello(1))
        client.reply(w.WELCOME)
        for sequence in (2, 3, 4):
            client.send(frame(w.HEARTBEAT, sequence))
            client.reply(w.ACK)
        assert made.server.calls == (("HEARTBEAT", None),) * 2
        assert made.report()["requests"] == 3
