"""The engine's end of the channel: unread messages are neither silence nor the end of the connection."""

from __future__ import annotations

import json
import logging
import socket
import threading
import time
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest

from escape_hw.server.engine.main import Engine
from escape_hw.server.engine.state import EngineState, LoopParameters
from escape_hw.server.ipc import channel as channel_module
from escape_hw.server.ipc.channel import Channel, encode
from escape_hw.supervision import BackgroundThread


@pytest.fixture
def ends() -> Iterator[tuple[Channel, socket.socket]]:
    ours, theirs = socket.socketpair()
    channel = Channel(ours)
    yield channel, theirs
    channel.close()
    theirs.close()


def test_an_unread_message_is_neither_silence_nor_the_end(ends: tuple[Channel, socket.socket]) -> None:
    channel, theirs = ends
    assert not channel.has_unread
    theirs.sendall(encode({"heartbeat": True}))
    assert channel.has_unread
    assert channel.silence_s == 0
    assert next(channel.messages()) == {"heartbeat": True}
    assert not channel.has_unread
    theirs.close()
    assert not channel.has_unread


def test_an_engine_that_had_no_time_to_read_does_not_take_the_front_end_for_silent(
    ends: tuple[Channel, socket.socket],
) -> None:
    channel, theirs = ends
    reasons: list[str] = []
    engine: Any = Engine.__new__(Engine)
    engine._channel, engine._front_end_timeout_s = channel, 0.1
    engine._state = EngineState(LoopParameters())
    engine._owner = SimpleNamespace(request_safe_state=reasons.append)
    theirs.sendall(encode({"heartbeat": True}))
    # As if the engine had read its last message long ago.
    channel._last_message_s -= 60
    engine._check_front_end()
    assert not reasons
    silence = BackgroundThread("silence", engine._check_front_end, period_s=0.02)
    silence.start()
    # Read, and nothing after it: now the front end is silent.
    next(channel.messages())
    until = time.monotonic() + 10
    while not reasons and time.monotonic() < until:
        time.sleep(0.01)
    silence.stop()
    assert "the server's front end was silent for" in reasons[0]


def test_a_slow_reader_loses_states_but_no_replies_and_no_ends(
    ends: tuple[Channel, socket.socket], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    channel, theirs = ends
    monkeypatch.setattr(channel_module, "_MAX_QUEUED", 2)
    # Nobody takes messages out of the queue any more.
    theirs.close()
    channel.post({"state": 0})
    channel._sender.join(10)
    kept: list[dict[str, Any]] = [
        {"state": 1}, {"progress": 2}, {"reply": 3, "answer": None}, {"run": 4}, {"ended": 5},
        {"log": {"level": "ERROR"}}, {"clean_exit": True},
    ]  # fmt: skip
    with caplog.at_level(logging.WARNING):
        for message in [*kept[:2], {"state": 6}, {"progress": 7}, {"log": {"level": "INFO"}}, *kept[2:]]:
            channel.post(message)
    queued = [channel._queue.get_nowait() for _ in kept]
    assert [json.loads(line or b"") for line in queued] == kept
    assert channel._queue.empty()
    assert [record.args for record in caplog.records] == [(1,), (2,)]


def test_a_background_thread_that_fails_is_reported() -> None:
    """A failed request handler or publisher must become a fault, not a silent stop."""
    failures: list[Exception] = []
    ended = threading.Event()

    def fail() -> None:
        raise RuntimeError("defect")

    def on_failure(error: Exception) -> None:
        failures.append(error)
        ended.set()

    BackgroundThread("requests", fail, on_failure=on_failure).start()
    assert ended.wait(10)
    assert [str(error) for error in failures] == ["defect"]
