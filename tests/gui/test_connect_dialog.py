"""The dialog to connect to a server, with clicks and keys."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from gui_windows import dispose
from PySide6.QtCore import Qt
from PySide6.QtTest import QTest
from pytestqt.qtbot import QtBot
from recorded_run import make_run
from scripted import running
from test_gui_live import Network

from escape_gui.app import WindowController
from escape_gui.client import connection as live
from escape_gui.client.session import EmptySource, Session
from escape_gui.main_window import MainWindow
from escape_gui.panels.devices import DevicesPanel
from escape_gui.replay.source import ReplaySource
from escape_gui.settings import Settings
from escape_gui.window.connect_dialog import ConnectDialog
from escape_hw.remote import keys
from escape_hw.remote.address import ServerListing, register_server, unregister_server
from escape_hw.remote.state import LoopState
from escape_hw.supervision import process_start


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Listings and keys in a temporary folder."""
    for name in ("XDG_RUNTIME_DIR", "XDG_CONFIG_HOME"):
        (tmp_path / name).mkdir(mode=0o700)
        monkeypatch.setenv(name, str(tmp_path / name))


class StartedServer:
    """A server that the window started."""

    exit_message = ""

    def __init__(self, system: str) -> None:
        self.system, self.left, self.terminated = system, False, False

    def leave(self) -> None:
        self.left = True

    def terminate(self, _: object) -> None:
        self.terminated = True


@pytest.fixture
def network(monkeypatch: pytest.MonkeyPatch) -> Network:
    network = Network()
    monkeypatch.setattr(live, "connect", network.connect)
    monkeypatch.setattr(live, "_RECONNECT_AFTER_S", 0.1)
    for name in ("_RETRY_S", "_LOCAL_PERIOD_S", "_REMOTE_PERIOD_S"):
        monkeypatch.setattr(live, name, 0.02)
    return network


@pytest.fixture
def started() -> list[StartedServer]:
    return []


@pytest.fixture
def controller(network: Network, started: list[StartedServer]) -> Iterator[WindowController]:
    """A window without a server."""

    def start(system: str) -> StartedServer:
        started.append(StartedServer(system))
        return started[-1]

    session = Session()
    window = MainWindow(session, Settings(), None, (DevicesPanel,))
    window.show()
    controller = WindowController(window, session, "", None, start)  # type: ignore[arg-type]
    yield controller
    dispose(window)
    session.close()
    session.deleteLater()
    controller.close()
    for attachment in (*controller._stopped, controller.attachment):
        if attachment is not None:
            attachment.deleteLater()
    controller.deleteLater()


@pytest.fixture
def dialog(controller: WindowController) -> ConnectDialog:
    controller.window.actions_by_name["connect"].trigger()
    return controller.window.connect_dialog


@pytest.fixture
def listed() -> Iterator[str]:
    """A server of this computer; its process is this one."""
    start = process_start(os.getpid())
    assert start is not None
    listing = ServerListing("bench-1", os.getpid(), start, "ipc:///x.req", "ipc:///x.pub", "")
    register_server(listing)
    yield listing.system
    unregister_server(listing)


def test_servers_of_this_computer_are_found_and_connected(
    listed: str, dialog: ConnectDialog, controller: WindowController, network: Network, qtbot: QtBot
) -> None:
    assert dialog.servers.item(0).text() == f"bench-1   process {os.getpid()}"
    assert isinstance(controller.session.source, EmptySource)
    qtbot.mouseClick(dialog.connect_button, Qt.MouseButton.LeftButton)
    qtbot.waitUntil(lambda: not isinstance(controller.session.source, EmptySource))
    assert controller.attachment is not None
    assert controller.attachment.address == "bench-1"
    assert not dialog.isVisible(), "the dialog closes when the window is connected"


def test_without_a_server_there_is_none_to_select(dialog: ConnectDialog) -> None:
    assert dialog.servers.item(0).text() == "none"
    assert not dialog.connect_button.isEnabled()
    assert "select a server" in dialog.connect_button.toolTip()


def test_an_address_needs_keys_which_the_dialog_stores(
    dialog: ConnectDialog, controller: WindowController, network: Network, qtbot: QtBot
) -> None:
    QTest.keyClicks(dialog.address, "tcp://bench.example.org")
    QTest.keyClick(dialog.address, Qt.Key.Key_Return)
    assert "is no address" in dialog.message.text()
    QTest.keyClicks(dialog.address, ":5555")
    qtbot.mouseClick(dialog.address_button, Qt.MouseButton.LeftButton)
    assert "requires a key" in dialog.message.text()
    assert network.made == []
    qtbot.mouseClick(dialog.make_key_button, Qt.MouseButton.LeftButton)
    own = keys.own_keys()
    assert own is not None
    assert own.public.decode() in dialog.own_key.text()
    qtbot.mouseClick(dialog.address_button, Qt.MouseButton.LeftButton)
    assert "the key of bench.example.org is unknown" in dialog.message.text()
    QTest.keyClicks(dialog.server_key, "too short")
    qtbot.mouseClick(dialog.address_button, Qt.MouseButton.LeftButton)
    assert "is not a key" in dialog.message.text()
    dialog.server_key.clear()
    QTest.keyClicks(dialog.server_key, own.public.decode())
    qtbot.mouseClick(dialog.address_button, Qt.MouseButton.LeftButton)
    qtbot.waitUntil(lambda: bool(network.made))
    assert keys.trusted_keys() == {"bench.example.org": own.public}


def test_a_server_is_started_here_and_left_running_for_another(
    listed: str, dialog: ConnectDialog, controller: WindowController, started: list[StartedServer],
    network: Network, qtbot: QtBot,
) -> None:  # fmt: skip
    dialog.system.setCurrentText("maps-nir")
    qtbot.mouseClick(dialog.start_button, Qt.MouseButton.LeftButton)
    qtbot.waitUntil(lambda: not dialog.isVisible())
    assert [one.system for one in started] == ["maps-nir"]
    assert controller.window.started_server
    controller.window.actions_by_name["connect"].trigger()
    qtbot.mouseClick(dialog.connect_button, Qt.MouseButton.LeftButton)
    qtbot.waitUntil(lambda: len(network.made) == 2 and network.made[0].closed)
    assert started[0].left
    assert not controller.window.started_server


@pytest.fixture
def recording(tmp_path: Path) -> ReplaySource:
    return ReplaySource(make_run(tmp_path / "run"))


def test_a_recorded_run_stays_when_the_first_connection_is_made(
    controller: WindowController, network: Network, recording: ReplaySource, qtbot: QtBot
) -> None:
    window, session = controller.window, controller.session
    window.show_recording(recording)
    # As by the command: the connection is made some seconds later.
    controller._attach("bench-1", None)
    qtbot.waitUntil(window.server_banner.isVisible)
    assert session.source is recording
    assert session.control is None
    assert "Connected to bench-1" in window.server_banner.text.text()
    # A server that was restarted meanwhile waits in the place of the one before.
    first = network.made[0]
    first.connected = False
    qtbot.waitUntil(lambda: len(network.made) == 2 and first.closed)
    assert session.source is recording
    qtbot.mouseClick(window.server_banner.button, Qt.MouseButton.LeftButton)
    assert session.control is network.made[1]
    assert not window.server_banner.isVisible()
    window.refresh()
    assert "REPLAY" not in window.windowTitle()


def test_the_dialog_leaves_a_recorded_run(
    listed: str, controller: WindowController, network: Network, recording: ReplaySource, qtbot: QtBot
) -> None:
    window, session = controller.window, controller.session
    window.show_recording(recording)
    window.actions_by_name["connect"].trigger()
    network.reachable = False
    qtbot.mouseClick(window.connect_dialog.connect_button, Qt.MouseButton.LeftButton)
    qtbot.waitUntil(lambda: "no server of 'bench-1' runs here" in window.connect_dialog.message.text())
    assert session.source is recording, "it stays until the window is connected"
    network.reachable = True
    qtbot.waitUntil(lambda: session.control is not None)
    assert not window.connect_dialog.isVisible()
    # Behind a recorded run, the same connection is used again.
    window.show_recording(recording)
    window.replay_windows[0].close()
    assert session.control is network.made[0]


def test_the_dialog_shows_the_server_behind_a_recorded_run(
    listed: str, controller: WindowController, network: Network, recording: ReplaySource,
    started: list[StartedServer], qtbot: QtBot,
) -> None:  # fmt: skip
    window, session = controller.window, controller.session
    window.show_recording(recording)
    server = StartedServer("bench-1")
    controller._attach("bench-1", server)  # type: ignore[arg-type]
    qtbot.waitUntil(window.server_banner.isVisible)
    window.actions_by_name["connect"].trigger()
    qtbot.mouseClick(window.connect_dialog.connect_button, Qt.MouseButton.LeftButton)
    assert session.control is network.made[0]
    assert len(network.made) == 1
    assert not server.left, "it is still the server of this window"
    qtbot.waitUntil(lambda: "acquire" in network.made[0].asked)


@pytest.mark.parametrize("busy", [False, True])
def test_a_server_behind_a_recorded_run_is_ended_unless_something_runs_there(
    controller: WindowController, network: Network, recording: ReplaySource, busy: bool, qtbot: QtBot
) -> None:
    controller.window.show_recording(recording)
    server = StartedServer("bench-1")
    controller._attach("bench-1", server)  # type: ignore[arg-type]
    qtbot.waitUntil(controller.window.server_banner.isVisible)
    network.made[0].state = running(loop=LoopState(closed=busy))
    controller.window.close()
    controller.session.close()
    controller.close()
    assert (server.left, server.terminated) == (busy, not busy)


def test_a_connection_that_fails_says_why(
    listed: str, dialog: ConnectDialog, network: Network, qtbot: QtBot
) -> None:
    network.reachable = False
    qtbot.mouseClick(dialog.connect_button, Qt.MouseButton.LeftButton)
    qtbot.waitUntil(lambda: "no server of 'bench-1' runs here" in dialog.message.text())
    assert dialog.isVisible()
