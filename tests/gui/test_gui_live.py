"""Connection to a server: slow requests are made in a thread, and a lost server is found again."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from types import SimpleNamespace

import numpy as np
import pytest
from pytestqt.qtbot import QtBot
from scripted import CLIENT, ScriptedSource, running

from escape_gui.app import WindowController
from escape_gui.client import connection as live
from escape_gui.client.connection import LiveSource, ServerAttachment
from escape_gui.client.session import Session
from escape_gui.main_window import MainWindow
from escape_hw.errors import ServerGone
from escape_hw.remote.source import Sample
from escape_hw.remote.state import Geometry, ProcedureEntry


class FakeConnection(ScriptedSource):
    """A connection that records the threads of its slow requests."""

    client = CLIENT

    def __init__(self) -> None:
        super().__init__()
        self.push_all()
        self.entries = (ProcedureEntry(name="escape", title="ESCAPE", help=""),)
        self.askers: set[threading.Thread] = set()
        self.closed = False
        self.asked: list[str] = []

    def geometry(self) -> Geometry:
        self.askers.add(threading.current_thread())
        return super().geometry()

    def latest(self, stream: str, after: int = -1) -> Sample | None:
        self.askers.add(threading.current_thread())
        return super().latest(stream, after)

    def close(self) -> None:
        self.closed = True

    def acquire(self, *, take_over: bool = False) -> None:
        self.asked.append("acquire")


class Network:
    """Replaces ``connect``; fails unless ``reachable``."""

    def __init__(self) -> None:
        self.reachable = True
        self.made: list[FakeConnection] = []

    def connect(self, address: str, **_: object) -> FakeConnection:
        if not self.reachable:
            raise ServerGone(f"no server of '{address}' runs here")
        self.made.append(FakeConnection())
        return self.made[-1]


@pytest.fixture
def network(monkeypatch: pytest.MonkeyPatch) -> Network:
    network = Network()
    monkeypatch.setattr(live, "connect", network.connect)
    monkeypatch.setattr(live, "_RECONNECT_AFTER_S", 0.3)
    monkeypatch.setattr(live, "_RETRY_S", 0.02)
    monkeypatch.setattr(live, "_LOCAL_PERIOD_S", 0.02)
    return network


@pytest.fixture
def found() -> list[LiveSource]:
    return []


def attach(address: str, found: list[LiveSource]) -> Iterator[ServerAttachment]:
    attachment = ServerAttachment(address)
    attachment.attached.connect(found.append)
    attachment.start()
    yield attachment
    attachment.close()
    attachment.deleteLater()


@pytest.fixture
def local(network: Network, found: list[LiveSource]) -> Iterator[ServerAttachment]:
    yield from attach("razor-shwfs", found)


@pytest.fixture
def remote(network: Network, found: list[LiveSource]) -> Iterator[ServerAttachment]:
    yield from attach("tcp://bench:5555", found)


def test_slow_requests_are_made_in_the_thread(
    local: ServerAttachment, found: list[LiveSource], network: Network, qtbot: QtBot
) -> None:
    qtbot.waitUntil(lambda: bool(found) and bool(found[0].procedures()))
    source = found[0]
    places = source.geometry()
    assert places == network.made[0].geometry_data
    assert threading.current_thread() not in network.made[0].askers
    # Streams of a local server are read from shared memory in the calling thread.
    assert source.latest("frames") is not None
    assert threading.current_thread() in network.made[0].askers
    assert source.geometry() is places


def test_streams_of_a_remote_server_do_not_block_the_window(
    remote: ServerAttachment, found: list[LiveSource], network: Network, qtbot: QtBot
) -> None:
    qtbot.waitUntil(lambda: bool(found))
    source = found[0]
    assert source.latest("psf") is None
    qtbot.waitUntil(lambda: source.latest("psf") is not None)
    first = source.latest("psf")
    assert first is not None
    assert source.latest("psf", first.index) is None
    network.made[0].push("psf", np.ones((2, 2)))
    qtbot.waitUntil(lambda: source.latest("psf", first.index) is not None)
    assert threading.current_thread() not in network.made[0].askers


def test_a_restarted_server_is_found(
    local: ServerAttachment, found: list[LiveSource], network: Network, qtbot: QtBot
) -> None:
    qtbot.waitUntil(lambda: len(found) == 1)
    reasons: list[str] = []
    local.connection_failed.connect(reasons.append)
    network.reachable = False
    network.made[0].connected = False
    qtbot.waitUntil(lambda: bool(reasons))
    assert set(reasons) == {"no server of 'razor-shwfs' runs here"}
    network.reachable = True
    qtbot.waitUntil(lambda: len(found) == 2)
    assert found[1].connected
    local.discard(found[0])
    qtbot.waitUntil(lambda: network.made[0].closed)


def test_close_closes_the_connection(network: Network, found: list[LiveSource], qtbot: QtBot) -> None:
    for attachment in attach("razor-shwfs", found):
        qtbot.waitUntil(lambda: bool(found))
        network.made[0].state = running(serial=5)
        assert found[0].state.serial == 5
        assert attachment.address == "razor-shwfs"
    assert network.made[0].closed


def test_the_message_without_a_server_is_closed_when_one_answers(
    small_window: MainWindow, session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ServerAttachment, "start", lambda self: None)
    controller = WindowController(small_window, session, "razor-shwfs", None)
    controller.attachment.connection_failed.emit("no server of 'razor-shwfs' runs here")
    titles = [one.title for one in small_window.notifications.notifications]
    assert titles == ["No server"]
    small_window.notifications.close_messages("No server")
    controller.attachment.connection_failed.emit("no server of 'razor-shwfs' runs here")
    assert small_window.notifications.notifications == [], "the same reason is repeated"
    live = LiveSource(FakeConnection(), is_local=True)
    monkeypatch.setattr(ServerAttachment, "live", live)
    controller.attachment.attached.emit(live)
    assert small_window.notifications.notifications == []
    controller.close()
    controller.deleteLater()


def test_a_started_server_that_ends_is_reported(
    small_window: MainWindow, session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ServerAttachment, "start", lambda self: None)
    server = SimpleNamespace(exit_message="", terminate=lambda connection: None)
    controller = WindowController(small_window, session, "razor-shwfs", server)
    for message in ("", "error: the disk is full", "error: the disk is full"):
        server.exit_message = message
        controller.attachment.connection_failed.emit("no server of 'razor-shwfs' runs here")
    (shown,) = small_window.notifications.notifications
    assert (shown.title, shown.text) == ("The server did not start", "error: the disk is full")
    controller.close()
    controller.deleteLater()
