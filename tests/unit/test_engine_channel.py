"""The engine's end of the channel: what waits there is told from silence and from the end."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from types import SimpleNamespace

import pytest

from escape_hw.server import jobs
from escape_hw.server.channel import Channel, encode
from escape_hw.server.desk import Desk


@pytest.fixture
def ends() -> Iterator[tuple[Channel, socket.socket]]:
    ours, theirs = socket.socketpair()
    channel = Channel(ours)
    yield channel, theirs
    channel.close()
    theirs.close()


def test_what_waits_is_neither_silence_nor_the_end(ends: tuple[Channel, socket.socket]) -> None:
    channel, theirs = ends
    assert not channel.waiting
    theirs.sendall(encode({"alive": True}))
    assert channel.waiting
    assert next(channel.messages()) == {"alive": True}
    assert not channel.waiting
    theirs.close()
    assert not channel.waiting


def test_a_desk_that_had_no_time_to_listen_takes_nobody_for_silent(
    ends: tuple[Channel, socket.socket], monkeypatch: pytest.MonkeyPatch
) -> None:
    channel, theirs = ends
    reasons: list[str] = []
    monkeypatch.setattr(jobs, "make_safe_now", lambda engine, reason: reasons.append(reason))
    board = SimpleNamespace(fault=None)
    engine = SimpleNamespace(setup=SimpleNamespace(silence_s=0.1), board=board, channel=channel)
    desk = Desk(engine, iter(()))
    theirs.sendall(encode({"alive": True}))
    threading.Thread(target=desk._listen_for_silence, daemon=True).start()
    time.sleep(0.5)
    assert not reasons
    # Taken, and nothing after it: now the front is silent.
    next(channel.messages())
    until = time.monotonic() + 10
    while not reasons and time.monotonic() < until:
        time.sleep(0.01)
    board.fault = "latched"
    assert "the server's front was silent for" in reasons[0]
