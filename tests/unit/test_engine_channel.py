"""The engine's end of the channel: what waits there is told from silence and from the end."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from types import SimpleNamespace

import pytest

from escape_hw.server.engine import runner as jobs
from escape_hw.server.engine.request_handler import RequestHandler
from escape_hw.server.ipc.channel import Channel, encode


@pytest.fixture
def ends() -> Iterator[tuple[Channel, socket.socket]]:
    ours, theirs = socket.socketpair()
    channel = Channel(ours)
    yield channel, theirs
    channel.close()
    theirs.close()


def test_what_waits_is_neither_silence_nor_the_end(ends: tuple[Channel, socket.socket]) -> None:
    channel, theirs = ends
    assert not channel.has_unread
    theirs.sendall(encode({"alive": True}))
    assert channel.has_unread
    assert next(channel.messages()) == {"alive": True}
    assert not channel.has_unread
    theirs.close()
    assert not channel.has_unread


def test_a_desk_that_had_no_time_to_listen_takes_nobody_for_silent(
    ends: tuple[Channel, socket.socket], monkeypatch: pytest.MonkeyPatch
) -> None:
    channel, theirs = ends
    reasons: list[str] = []
    monkeypatch.setattr(jobs, "make_safe_now", lambda engine, reason: reasons.append(reason))
    engine_state = SimpleNamespace(fault=None)
    engine = SimpleNamespace(
        setup=SimpleNamespace(front_end_timeout_s=0.1), engine_state=engine_state, channel=channel
    )
    request_handler = RequestHandler(engine, iter(()))
    theirs.sendall(encode({"alive": True}))
    threading.Thread(target=request_handler._watch_for_silence, daemon=True).start()
    time.sleep(0.5)
    assert not reasons
    # Taken, and nothing after it: now the front is silent.
    next(channel.messages())
    until = time.monotonic() + 10
    while not reasons and time.monotonic() < until:
        time.sleep(0.01)
    engine_state.fault = "latched"
    assert "the server's front was silent for" in reasons[0]
