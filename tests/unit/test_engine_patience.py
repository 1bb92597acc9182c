"""How long a front waits for its engine's words."""

from __future__ import annotations

import socket

import pytest

from escape_hw.server.channel import Lines, encode
from escape_hw.server.engine_process import STARTING_S, EngineProcess


def test_an_engine_that_starts_may_be_silent_for_longer(monkeypatch: pytest.MonkeyPatch) -> None:
    ours, theirs = socket.socketpair()
    ours.setblocking(False)
    monkeypatch.setattr(EngineProcess, "__init__", lambda self: None)
    engine = EngineProcess()  # type: ignore[call-arg]
    engine.connection, engine._lines = ours, Lines()
    engine.said_goodbye = engine.has_spoken = False
    with ours, theirs:
        assert list(engine.receive()) == []
        assert engine.patience(10.0) == STARTING_S > 10.0
        assert engine.patience(300.0) == 300.0
        theirs.sendall(encode({"log": {}}))
        assert list(engine.receive()) == [{"log": {}}]
        assert engine.patience(10.0) == 10.0
