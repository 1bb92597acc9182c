"""Framing and parsing of the General Command Set, at both ends, for any fragmentation."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from escape_drivers.pi import gcs as pi_gcs
from escape_drivers.pi.gcs import GcsError, MalformedReply, ReplyReader
from escape_sim.emulators.e727.controller import E727Controller
from escape_sim.emulators.e727.gcs import MAX_LINE, CommandFramer, format_array, format_lines
from escape_sim.emulators.e727.state import ControllerSettings

#: What a line of a reply may hold: anything but line ends, NUL and a blank at its end.
TEXT = st.text(st.characters(min_codepoint=33, max_codepoint=126), min_size=1, max_size=30)
REPLY = st.lists(TEXT, min_size=1, max_size=5)


def pieces(data: bytes, cuts: list[int]) -> list[bytes]:
    """Data cut at these places."""
    at = sorted({0, len(data), *(cut % (len(data) + 1) for cut in cuts)})
    return [data[a:b] for a, b in pairwise(at)]


def taken(reader: ReplyReader) -> list[list[str]]:
    found = []
    while (reply := reader.next_reply()) is not None:
        found.append(reply)
    return found


@given(st.lists(REPLY, min_size=1, max_size=4), st.lists(st.integers(0, 500), max_size=20))
def test_replies_come_out_as_they_went_in_however_they_are_cut(replies, cuts):
    reader, found = ReplyReader(), []
    for piece in pieces("".join(map(format_lines, replies)).encode(), cuts):
        reader.feed(piece)
        found += taken(reader)
    assert found == replies
    assert reader.pending == 0


@given(REPLY)
def test_replies_come_out_byte_by_byte_and_padded_with_nul(reply):
    reader, found = ReplyReader(), []
    for byte in format_lines(reply).encode():
        reader.feed(bytes([byte, 0]))
        found += taken(reader)
    assert found == [reply]


@given(REPLY, st.integers(1, 200))
def test_a_cut_reply_is_none(reply, cut):
    data = format_lines(reply).encode()
    reader = ReplyReader()
    reader.feed(data[: -min(cut, len(data))])
    assert reader.next_reply() is None


@given(st.binary(max_size=400))
def test_garbage_neither_hangs_nor_crashes_the_reader(noise):
    reader = ReplyReader()
    reader.feed(noise)
    for reply in taken(reader):
        for parse in (
            pi_gcs.parse_single_line,
            lambda reply: pi_gcs.parse_floats(reply, ["1", "2"]),
            lambda reply: pi_gcs.array(reply, 2, 3),
        ):
            try:
                parse(reply)
            except MalformedReply as error:
                assert str(error)  # noqa: PT017


def test_a_reply_without_end_is_given_up(monkeypatch):
    monkeypatch.setattr(pi_gcs, "MAX_REPLY", 100)
    reader = ReplyReader()
    with pytest.raises(MalformedReply, match="101 bytes without an end"):
        reader.feed(b"x" * 101)
    assert reader.pending == 0


@given(st.lists(st.floats(-1e6, 1e6), min_size=2, max_size=2))
def test_values_are_read_as_printed_and_only_for_the_axes_asked(values):
    reply = [f"{key}={value:.9e}" for key, value in zip("12", values, strict=True)]
    assert pi_gcs.parse_floats(reply, ["1", "2"]) == pytest.approx(values, rel=1e-9)
    for wrong in (reply[:1], reply[::-1], [*reply, "3=0"], [reply[0], reply[0]]):
        with pytest.raises(MalformedReply, match="where values of 1, 2 were due"):
            pi_gcs.parse_floats(wrong, ["1", "2"])


@pytest.mark.parametrize("text", ["nan", "inf", "-inf", "", "x", "1 2", "1,0"])
def test_what_is_no_finite_number_is_garbled(text):
    with pytest.raises(MalformedReply, match="where a number was due"):
        pi_gcs.parse_floats([f"1={text}"], ["1"])


@given(st.integers(1, 40), st.integers(1, 4))
@settings(max_examples=25)
def test_arrays_survive_the_wire_and_nothing_less_than_whole_is_taken(rows, columns):
    data = np.round(np.random.default_rng(rows).normal(size=(rows, columns)) * 1e3, 6)
    reader = ReplyReader()
    reader.feed(format_array({f"c{k}": data[:, k] for k in range(columns)}, 5e-5).encode())
    reply = reader.next_reply()
    assert reply is not None
    assert pi_gcs.array(reply, columns, rows) == pytest.approx(data, abs=1e-6)
    for wrong in (reply[:-1], reply[1:] if rows == 1 else reply[-2:], [*reply, reply[-1]]):
        with pytest.raises(MalformedReply):
            pi_gcs.array(wrong, columns, rows + (wrong == reply[1:]))


@pytest.mark.parametrize("bad", [["MOV", "1\n2"], ["MOV", ""], ["MOV", "1 2"], ["M V"], ["MOV", "µ"]])
def test_what_would_be_another_command_is_never_sent(bad):
    with pytest.raises(ValueError, match="cannot be sent"):
        pi_gcs.format_command(*bad)


def test_lines_are_short_and_finite():
    assert pi_gcs.format_command("MOV", "1", 1000.123456789, "2", -3) == b"MOV 1 1000.123457 2 -3\n"
    assert len(pi_gcs.format_command("WAV", *range(32)).split()) == 33
    with pytest.raises(ValueError, match="a line takes 32"):
        pi_gcs.format_command("WAV", *range(33))
    with pytest.raises(ValueError, match="only finite numbers"):
        pi_gcs.format_command("MOV", "1", float("nan"))


def test_every_refusal_states_what_to_do_and_crosses_to_another_process():
    import pickle

    for number in (7, 98, 4711):
        error = GcsError("stage", number, "MOV 1 5000")
        assert str(error).startswith(f"stage: refused 'MOV 1 5000': error {number}, ")
        assert ";" in str(error)
        copy = pickle.loads(pickle.dumps(error))
        assert (str(copy), copy.number) == (str(error), number)


# ---------------------------------------------------------------------- the controller's end
@given(st.lists(TEXT, min_size=1, max_size=5), st.lists(st.integers(0, 200), max_size=20))
def test_commands_are_whole_however_they_are_cut(commands, cuts):
    framer, found = CommandFramer(), []
    for piece in pieces("".join(f"{text}\n" for text in commands).encode(), cuts):
        found += list(framer.feed(piece))
    assert found == commands


@given(st.binary(max_size=300))
@settings(max_examples=60)
def test_garbage_neither_crashes_the_controller_nor_moves_anything(noise):
    controller = E727Controller(ControllerSettings(zeroed=True), clock=lambda: 0.0)
    for format_command in controller.receive(noise.replace(b"\n", b" ") + b"\n"):
        controller.execute(format_command)
    assert controller.state.describe() == "at rest"


WORDS = [*"0123X&+", "-1", "1e9", "nan", "SIN_P", "PNT", "0x101", "40", "900", "262145", "9" * 30, "advanced"]
SAID = st.tuples(
    st.sampled_from(sorted(E727Controller()._handlers)), st.lists(st.sampled_from(WORDS), max_size=8)
)


@given(st.lists(SAID, max_size=12))
@settings(max_examples=60, deadline=None)
def test_any_text_gets_a_reply_or_an_error(said):
    now = [0.0]
    controller = E727Controller(ControllerSettings(zeroed=True), clock=lambda: now[0])
    for name, words in said:
        now[0] += 1e-3
        (format_command,) = controller.receive(f"{name} {' '.join(words)}\n".encode())
        reply = controller.execute(format_command)
        error = int(controller.execute("ERR?"))
        assert bool(reply) == (name.endswith("?") and error == 0), (name, words, error)


@given(st.integers(1, 20))
def test_a_command_that_is_not_whole_is_not_carried_out(cut):
    controller = E727Controller(ControllerSettings(zeroed=True), clock=lambda: 0.0)
    command = b"SVO 1 1 2 1\n"
    assert controller.receive(command[: -min(cut, len(command))]) == []
    controller.end_session()
    assert [controller.execute(format_command) for format_command in controller.receive(b"SVO?\n")] == [
        b"1=0 \n2=0\n"
    ]


def test_a_line_without_end_is_refused_and_the_next_one_understood():
    framer = CommandFramer()
    assert list(framer.feed(b"x" * (MAX_LINE + 5) + b"\nERR?\n")) == [None, "ERR?"]


def test_bytes_that_are_commands_are_taken_out_of_the_line():
    assert list(CommandFramer().feed(b"PO\x05S?\n\x09\0")) == ["\x05", "POS?", "\x09"]
