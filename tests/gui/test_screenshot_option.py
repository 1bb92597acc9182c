"""The option ``--screenshot`` of ``escape gui`` and ``escape replay``: an image, or why there is none."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import recorded_run
from gui_windows import dispose
from PySide6.QtCore import QTimer

from escape_gui import app
from escape_gui.client import connection
from escape_gui.main_window import MainWindow
from escape_gui.panels.log import LogPanel
from escape_hw.errors import ServerGone

#: Runs the command: exit code, standard output, standard error.
Escape = Callable[..., tuple[int, str, str]]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recorded_run.make_run(tmp_path_factory.mktemp("recorded") / "run")


@pytest.fixture(autouse=True)
def small_windows(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Windows with one panel, without a delay, in a process that keeps its priority."""
    made: list[MainWindow] = []

    def make(*arguments: object) -> MainWindow:
        made.append(MainWindow(*arguments, (LogPanel,)))
        return made[-1]

    monkeypatch.setattr(app, "MainWindow", make)
    monkeypatch.setattr(app, "_SCREENSHOT_DELAY_MS", 0)
    monkeypatch.setattr(app, "_NICENESS", 0)
    yield
    for window in made:
        dispose(window)


def test_an_image_of_a_recording_is_saved(folder: Path, tmp_path: Path, escape: Escape) -> None:
    image = tmp_path / "window.png"
    assert escape("replay", folder, "--screenshot", image)[0] == 0
    assert image.read_bytes().startswith(b"\x89PNG")


def test_a_window_that_is_closed_before_leaves_no_image(
    folder: Path, tmp_path: Path, escape: Escape, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(app, "_SCREENSHOT_DELAY_MS", 60_000)
    make = app.MainWindow

    def closes_soon(*arguments: object) -> MainWindow:
        window = make(*arguments)
        QTimer.singleShot(300, window.close_without_question)
        return window

    monkeypatch.setattr(app, "MainWindow", closes_soon)
    assert escape("replay", folder, "--screenshot", tmp_path / "window.png")[0] == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.timeout(30)
def test_a_file_that_cannot_be_written_is_reported(folder: Path, tmp_path: Path, escape: Escape) -> None:
    (tmp_path / "file").touch()
    code, _, err = escape("replay", folder, "--screenshot", tmp_path / "file" / "window.png")
    assert code == 2
    assert f"error: {tmp_path / 'file'}: cannot be written" in err


@pytest.mark.timeout(30)
def test_a_server_that_does_not_answer_is_reported(
    tmp_path: Path, escape: Escape, monkeypatch: pytest.MonkeyPatch
) -> None:
    def connect(address: str, **_: object) -> None:
        raise ServerGone(f"{address}: no reply")

    monkeypatch.setattr(connection, "connect", connect)
    code, _, err = escape("gui", "--connect", "tcp://bench:5555", "--screenshot", tmp_path / "window.png")
    assert (code, list(tmp_path.iterdir())) == (3, [])
    assert "error: tcp://bench:5555: no reply" in err
