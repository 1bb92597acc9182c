"""The adaptive secondary's codec: known bytes, and arbitrary input in arbitrary fragments."""

from __future__ import annotations

import struct
import zlib
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from escape_drivers.asm import messages as m
from escape_drivers.asm.codec import HEADER_BYTES, MAX_PAYLOAD_BYTES, AsmCodec, encode_frame
from escape_hw.api.adaptive_secondary import ShellState
from escape_sim.emulators.asm import protocol as w
from escape_sim.emulators.asm.controller import AsmController, AsmLimits
from escape_sim.emulators.asm.replies import ReplyWriter
from escape_sim.mirror.shell import RealTimeActuators, Shell

N_ACT = 21


def body() -> AsmController:
    shell = Shell(RealTimeActuators(N_ACT, 1e-3), N_ACT, 1e-5, np.random.default_rng(1))
    return AsmController(shell, AsmLimits(8e-6, 5e-6, 0.3, 1.0), {3, 20})


ANSWERS = ReplyWriter(body(), "SN1")
#: One reply of every type as the emulator's own code writes it, and what must be read.
REPLIES: list[tuple[bytes, type]] = [
    (w.encode_frame(w.WELCOME, 1, 5, ANSWERS.welcome(1, 1, 0, 77)), m.Welcome),
    (w.encode_frame(w.ACK, 2, 5, ANSWERS.ack(2, w.SKIPPED, 3, 11)), m.Ack),
    (w.encode_frame(w.NAK, 3, 5, ANSWERS.nak(3, w.NOT_OWNER, "somebody has it")), m.Nak),
    (w.encode_frame(w.DONE, 4, 5, ANSWERS.done(4, "")), m.Done),
    (w.encode_frame(w.PARAM, 5, 5, ANSWERS.parameter(5, "telemetry_hz")), m.Param),
    (w.encode_frame(w.HEALTH, 6, 5, ANSWERS.health(6, "me", 2)), m.HealthReport),
    (w.encode_frame(w.TELEM, 7, 5, ANSWERS.telemetry()), m.TelemetrySample),
    (w.encode_frame(w.FAULT, 8, 5, ANSWERS.fault("dust")), m.FaultReport),
]
REQUESTS: list[tuple[m.Request, int]] = [
    (m.Hello(m.Role.CONTROL, 5, "me"), w.HELLO),
    (m.Heartbeat(), w.HEARTBEAT),
    (m.GetHealth(), w.GET_HEALTH),
    (m.SetState(ShellState.SET), w.SET_STATE),
    (m.Recover(), w.RECOVER),
    (m.SetDisabled((0, 9, 20), "dust"), w.SET_DISABLED),
    (m.GetParam("telemetry_hz"), w.GET_PARAM),
    (m.SetParam("telemetry_hz", 5.0), w.SET_PARAM),
]


def cut(data: bytes, places: list[int]) -> list[bytes]:
    marks = [0, *sorted({p % (len(data) + 1) for p in places}), len(data)]
    return [data[a:b] for a, b in pairwise(marks)]


# --------------------------------------------------------------------- known bytes
def test_a_frame_is_what_the_page_says() -> None:
    made = encode_frame(3, 0x01020304, 0x0A0B0C0D, b"\x07")
    head = b"ASM1" + bytes([1, 3, 0, 0]) + bytes([4, 3, 2, 1]) + bytes([1, 0, 0, 0])
    head += bytes([0x0D, 0x0C, 0x0B, 0x0A, 0, 0, 0, 0])
    assert made[:24] == head
    assert made[24:28] == zlib.crc32(head).to_bytes(4, "little")
    assert made[28:] == b"\x07" + zlib.crc32(b"\x07").to_bytes(4, "little")
    assert HEADER_BYTES == 28


def test_a_command_is_what_the_page_says() -> None:
    made = bytes(AsmCodec().command(7, 9, 3, np.array([1.0, -2.0])))
    payload = struct.pack("<IBxxx", 3, 1) + struct.pack("<2f", 1.0, -2.0)
    assert made == encode_frame(2, 7, 9, payload)


def test_a_command_of_another_length_takes_another_buffer() -> None:
    codec = AsmCodec()
    for n_act in (3, 5, 3):
        request = w.decode_frame(bytearray(codec.command(1, 1, 1, np.arange(float(n_act)))))
        assert request is not None
        found = w.read_command(request.payload, n_act)
        assert found is not None
        assert found[2].tolist() == list(range(n_act))


@pytest.mark.parametrize(("data", "kind"), REPLIES, ids=[kind.__name__ for _, kind in REPLIES])
def test_replies_of_the_emulator_are_read(data: bytes, kind: type) -> None:
    (reply,) = AsmCodec().feed(data)
    assert type(reply) is kind


def test_what_the_replies_say_is_what_was_meant() -> None:
    (welcome,) = AsmCodec().feed(REPLIES[0][0])
    assert isinstance(welcome, m.Welcome)
    assert (welcome.token, welcome.serial, welcome.disabled) == (77, "SN1", (3, 20))
    assert (welcome.max_command_m, welcome.max_step_m) == pytest.approx((8e-6, 5e-6))
    assert (welcome.hold_s, welcome.rest_s) == pytest.approx((0.3, 1.0))
    assert welcome.simulated
    assert welcome.last_command_m.tolist() == [0.0] * N_ACT
    (ack,) = AsmCodec().feed(REPLIES[1][0])
    assert isinstance(ack, m.Ack)
    assert (ack.echo, ack.result, ack.clipped, ack.received_ns) == (2, m.Result.SKIPPED, 3, 11)
    assert ack.positions.shape == (N_ACT,)
    (nak,) = AsmCodec().feed(REPLIES[2][0])
    assert nak == m.Nak(3, m.Result.NOT_OWNER, ShellState.OFF, "somebody has it")
    (health,) = AsmCodec().feed(REPLIES[5][0])
    assert isinstance(health, m.HealthReport)
    assert (health.contaminated, health.owner, health.crc_errors) == ((3, 20), "me", 2)
    assert AsmCodec().feed(REPLIES[7][0]) == [m.FaultReport(ShellState.OFF, "dust")]


@pytest.mark.parametrize(("message", "kind"), REQUESTS, ids=[type(r).__name__ for r, _ in REQUESTS])
def test_requests_are_read_by_the_emulator(message: m.Request, kind: int) -> None:
    buffer = bytearray(AsmCodec().request(12, 34, message))
    request = w.decode_frame(buffer)
    assert request is not None
    assert (request.kind, request.sequence, request.sent_ns, len(buffer)) == (kind, 12, 34, 0)
    if isinstance(message, m.Hello):
        assert w.read_hello(request.payload) == (1, 1, 0, 5, "me")
    if isinstance(message, m.SetDisabled):
        assert w.read_disabled(request.payload) == ({0, 9, 20}, "dust")


def test_what_does_not_fit_is_not_sent() -> None:
    with pytest.raises(ValueError, match="65536 that a frame may have"):
        encode_frame(1, 1, 1, b"\0" * (MAX_PAYLOAD_BYTES + 1))
    with pytest.raises(ValueError, match="longer than 65535"):
        AsmCodec().request(1, 1, m.GetParam("x" * 70000))


# --------------------------------------------------------------------- pieces
@settings(deadline=None)
@given(st.lists(st.sampled_from(range(len(REPLIES))), max_size=5), st.lists(st.integers(0, 5000), max_size=9))
def test_replies_in_any_pieces_are_the_same_replies(numbers: list[int], places: list[int]) -> None:
    codec, found = AsmCodec(), []
    for piece in cut(b"".join(REPLIES[k][0] for k in numbers), places):
        found += codec.feed(piece)
    assert [type(reply) for reply in found] == [REPLIES[k][1] for k in numbers]
    assert codec.frames == len(numbers)


def test_replies_byte_by_byte() -> None:
    codec, found = AsmCodec(), []
    for byte in b"".join(data for data, _ in REPLIES):
        found += codec.feed(bytes([byte]))
    assert [type(reply) for reply in found] == [kind for _, kind in REPLIES]


@settings(deadline=None)
@given(st.sampled_from([data for data, _ in REPLIES]), st.integers(0, 10000), st.integers(1, 255))
def test_no_damaged_frame_is_ever_a_reply(data: bytes, where: int, damage: int) -> None:
    spoiled = bytearray(data)
    spoiled[where % len(data)] ^= damage
    codec = AsmCodec()
    try:
        assert codec.feed(spoiled) == []
    except m.ProtocolError:
        with pytest.raises(m.ProtocolError):
            codec.feed(data)  # nothing after it is used


@settings(deadline=None)
@given(st.sampled_from([data for data, _ in REPLIES]), st.integers(0, 10000))
def test_a_frame_cut_short_is_no_reply(data: bytes, length: int) -> None:
    assert AsmCodec().feed(data[: length % len(data)]) == []


@settings(deadline=None)
@given(st.binary(min_size=1, max_size=200), st.lists(st.integers(0, 200), max_size=5))
def test_garbage_ends_in_an_error_or_waits_for_more(garbage: bytes, places: list[int]) -> None:
    codec = AsmCodec()
    try:
        found = [reply for piece in cut(garbage, places) for reply in codec.feed(piece)]
    except m.ProtocolError as error:
        assert str(error)  # noqa: PT017
    else:
        assert found == []
        assert b"ASM1".startswith(garbage[:4])


@settings(deadline=None)
@given(st.sampled_from(range(64, 80)), st.binary(max_size=120))
def test_sound_frames_with_nonsense_in_them_end_in_an_error_or_a_reply(kind: int, payload: bytes) -> None:
    codec = AsmCodec()
    try:
        replies = codec.feed(w.encode_frame(kind, 1, 1, payload))
    except m.ProtocolError as error:
        assert "makes no sense" in str(error)  # noqa: PT017
    else:
        assert len(replies) == 1


def test_a_frame_that_announces_too_much_is_refused_at_once() -> None:
    head = struct.pack("<4sBBHIIQ", b"ASM1", 1, 65, 0, 1, MAX_PAYLOAD_BYTES + 1, 0)
    with pytest.raises(m.ProtocolError, match="announces 65537 bytes; at most 65536"):
        AsmCodec().feed(head + struct.pack("<I", zlib.crc32(head)))


def test_another_version_is_named() -> None:
    head = struct.pack("<4sBBHIIQ", b"ASM1", 7, 65, 0, 1, 0, 0)
    with pytest.raises(m.ProtocolError, match="speaks version 7, this driver 1 to 1"):
        AsmCodec().feed(head + struct.pack("<I", zlib.crc32(head)))
