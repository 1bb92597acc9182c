"""Night log and log of a client that was disconnected from its server for a while."""

from __future__ import annotations

from typing import Any

import pytest

from escape_hw.errors import ServerFull
from escape_hw.io.night_log import NightEntry
from escape_hw.remote import client
from escape_hw.remote.address import Endpoint
from escape_hw.remote.client import Connection
from escape_hw.remote.state import Geometry, LogLine, State


class FakeServer:
    """Takes the place of the transport: a server with a night log and a log, whose events may be lost."""

    def __init__(self, endpoint: Endpoint, on_event, heartbeat, on_heartbeat_answer, keys=None) -> None:
        self._on_event, self._heartbeat, self._on_answer = on_event, heartbeat, on_heartbeat_answer
        self.entries: list[dict[str, Any]] = []
        self.lines: list[dict[str, Any]] = []
        self.asked: list[str] = []
        self.last_message_s = 0.0

    def answer(self, message) -> Any:
        self.asked.append(message["verb"])
        if message["verb"] == "hello":
            return self.state
        if message["verb"] == "night_log":
            return [one for one in self.entries if one["number"] > message["after"]][:1000]
        if message["verb"] == "log":
            return [one for one in self.lines if one["number"] > message["after"]][-message["count"] :]
        return None

    @property
    def state(self) -> dict[str, Any]:
        newest = self.lines[-1]["number"] if self.lines else -1
        state = State(last_night_entry=len(self.entries) - 1, last_log_line=newest)
        return state.model_dump(mode="json")

    def send_request(self, message, timeout_s: float):
        return self.answer(message), b"", 0

    def close(self) -> None:
        pass

    def add(self, text: str, lost: bool = False) -> None:
        """Write an entry, and publish it."""
        entry = NightEntry(number=len(self.entries), at_utc="2026-11-22T20:00:00", kind="note", text=text)
        self.entries.append(entry.model_dump(mode="json"))
        if not lost:
            self._on_event("night", self.entries[-1])

    def write(self, text: str, lost: bool = False, number: int | None = None) -> None:
        """Write a line into the log, and publish it."""
        following = self.lines[-1]["number"] + 1 if self.lines else 0
        line = LogLine(
            number=following if number is None else number, at_utc="2026-11-22T20:00:00", level="INFO",
            logger="escape_hw", text=text,
        )  # fmt: skip
        self.lines.append(line.model_dump(mode="json"))
        if not lost:
            self._on_event("log", self.lines[-1])

    def publish_state(self) -> None:
        self._on_event("state", self.state)

    def beat(self) -> None:
        """A heartbeat of the client."""
        if (message := self._heartbeat(False)) is not None:
            self._on_answer(self.answer(message))


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch):
    made: list[FakeServer] = []

    def make(*arguments, **options) -> FakeServer:
        made.append(FakeServer(*arguments, **options))
        return made[-1]

    monkeypatch.setattr(client, "ClientTransport", make)
    return made


def connect() -> Connection:
    return Connection(Endpoint("ipc://requests", "ipc://events"), "test")


def texts(connection: Connection) -> list[str]:
    return [entry.text for entry in connection.night_after(-1)]


def test_entries_that_were_published_while_disconnected_are_requested(server: list[FakeServer]) -> None:
    connection = connect()
    (served,) = server
    served.add("a")
    served.publish_state()
    served.add("b", lost=True)
    served.beat()
    assert texts(connection) == ["a"], "nothing has said so"
    served.publish_state()
    served.beat()
    assert texts(connection) == ["a", "b"]


def test_a_server_without_an_engine_is_not_asked_for_its_geometry(server: list[FakeServer]) -> None:
    connection = connect()
    (served,) = server
    assert connection.geometry() == Geometry()
    assert "geometry" not in served.asked, "the engine has died, or starts"


def test_an_entry_after_a_gap_comes_with_those_before_it(server: list[FakeServer]) -> None:
    connection = connect()
    (served,) = server
    for text, lost in (("a", False), ("b", True), ("c", False), ("d", False)):
        served.add(text, lost)
    served.beat()
    assert texts(connection) == ["a", "b", "c", "d"]
    served.add("e")
    asked = len(served.asked)
    served.beat()
    assert texts(connection)[-1] == "e"
    assert served.asked[asked:] == ["heartbeat"], "nothing is missing"


def test_a_client_that_waited_for_a_place_gets_all_entries(
    server: list[FakeServer], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(FakeServer, "send_request", lambda *_: (_ for _ in ()).throw(ServerFull("full")))
    connection = connect()
    (served,) = server
    served.add("a", lost=True)
    served.add("b")
    served.publish_state()
    served.beat()
    served.beat()
    assert texts(connection) == ["a", "b"]


def lines(connection: Connection) -> list[str]:
    return [line.text for line in connection.log_after(-1)]


def test_log_lines_that_were_published_while_disconnected_are_requested(server: list[FakeServer]) -> None:
    connection = connect()
    (served,) = server
    for text, lost in (("a", False), ("b", True), ("c", False), ("d", True)):
        served.write(text, lost)
    served.publish_state()
    served.beat()
    assert lines(connection) == ["a", "b", "c", "d"]
    asked = len(served.asked)
    served.write("e")
    served.beat()
    assert lines(connection)[-1] == "e"
    assert served.asked[asked:] == ["heartbeat"], "nothing is missing"


def test_the_first_lines_of_another_front_end_are_not_lost(server: list[FakeServer]) -> None:
    connection = connect()
    (served,) = server
    served.write("a")
    served.lines.clear()
    served.write("the engine starts", lost=True, number=10**9)
    served.write("client 1")
    assert lines(connection) == ["a"], "lines are shown in their order"
    served.beat()
    assert lines(connection) == ["a", "the engine starts", "client 1"]
