"""The browser of finished runs, with key presses and clicks."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from PySide6.QtCore import Qt
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QFileDialog
from pytestqt.qtbot import QtBot
from scripted import ScriptedControl, ScriptedSource

from escape_gui.main_window import MainWindow
from escape_gui.panels.loop import LoopPanel
from escape_gui.window.run_browser import RunBrowser
from escape_hw.remote.state import DiskState, LoopState, Phase, ProductEntry

DOCUMENT = {
    "system": "razor-shwfs", "simulated": True, "method": "escape", "frames": 1000, "converged": True,
    "snr": {"min": 12.0}, "products": {"im": "im.fits"},
}  # fmt: skip


def make_run(runs: Path, day: str, name: str, **changes: object) -> Path:
    folder = runs / day / name
    folder.mkdir(parents=True)
    (folder / "result.json").write_text(json.dumps({**DOCUMENT, **changes}))
    (folder / "im.fits").write_bytes(bytes(250_000))
    return folder


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    runs = tmp_path / "runs"
    make_run(runs, "2026-11-21", "214530_razor-shwfs_calibrate-escape-7")
    make_run(runs, "2026-11-22", "010203_maps-nir_calibrate-docrime-2", system="maps-nir", method="docrime",
             converged=None, snr={"min": 0.35})  # fmt: skip
    make_run(
        runs,
        "2026-11-22",
        "020304_razor-shwfs_model-psf-8",
        products={},
        method=None,
        converged=None,
        snr=None,
    )
    (runs / "2026-11-22" / "030405_razor-shwfs_broken-9").mkdir()
    for number, frames in enumerate(("many", [1], float("nan"), float("inf")), 10):
        make_run(runs, "2026-11-22", f"030405_razor-shwfs_odd-{number}", frames=frames)
    return runs


class LoadingControl(ScriptedControl):
    """Lists the products that it loads."""

    def __init__(self, source: ScriptedSource) -> None:
        super().__init__()
        self.source = source

    def load_product(self, path: Path, name: str | None) -> ProductEntry:
        self._note("load_product", path=path, name=name)
        product = ProductEntry(name=name or path.stem, kind="matrix", path=str(path), summary="94 modes")
        self.source.change(products=(*self.source.state.products, product))
        return product


@pytest.fixture
def control(source: ScriptedSource) -> ScriptedControl:
    return LoadingControl(source)


@pytest.fixture
def window(make_window: Callable[..., MainWindow], source: ScriptedSource, runs: Path) -> MainWindow:
    source.change(
        disk=DiskState(folder=str(runs), free_gb=1.0), phase=Phase.IDLE,
        loop=LoopState(matrix="escape", gain=0.4, n_modes=80),
    )  # fmt: skip
    return make_window((LoopPanel,))


@pytest.fixture
def browser(window: MainWindow, qtbot: QtBot) -> RunBrowser:
    """The browser, opened with the button of the loop panel."""
    QTest.mouseClick(window.panels["loop"].load_button, Qt.MouseButton.LeftButton)
    browser = window.run_browser
    qtbot.waitUntil(lambda: browser.table.rowCount() == 7)
    assert browser.isVisible()
    return browser


def shown(browser: RunBrowser) -> list[str]:
    table = browser.table
    return [table.item(k, 1).text() for k in range(table.rowCount()) if not table.isRowHidden(k)]


def click(browser: RunBrowser, name: str) -> None:
    table = browser.table
    (item,) = (table.item(k, 1) for k in range(table.rowCount()) if table.item(k, 1).text() == name)
    QTest.mouseClick(
        table.viewport(), Qt.MouseButton.LeftButton, pos=table.visualItemRect(item).center()
    )  # fmt: skip


def test_runs_are_listed_newest_first_and_filtered_by_typing(browser: RunBrowser) -> None:
    assert shown(browser) == ["odd-13", "odd-12", "odd-11", "odd-10", "model-psf-8", "docrime-2", "escape-7"]
    row = [browser.table.item(5, k).text() for k in range(browser.table.columnCount())]
    words = ("2026-11-22 01:02:03", "docrime-2", "maps-nir (simulated)", "DO-CRIME", "1,000", "not usable")
    assert row == [*words, "0.3 MB"]
    QTest.keyClicks(browser.filter, "razor good")
    assert shown(browser) == ["escape-7"]


def test_the_matrix_of_an_earlier_night_becomes_the_setpoint_of_the_loop(
    browser: RunBrowser, window: MainWindow, control: ScriptedControl, runs: Path, qtbot: QtBot
) -> None:
    assert not browser.load_button.isEnabled()
    assert "select a run" in browser.load_button.toolTip()
    click(browser, "escape-7")
    assert "SNR 12 in the worst mode" in browser.message.text()
    QTest.mouseClick(browser.load_button, Qt.MouseButton.LeftButton)
    loop = window.panels["loop"]
    qtbot.waitUntil(lambda: loop.matrix.currentText() == "escape-7")
    folder = runs / "2026-11-21" / "214530_razor-shwfs_calibrate-escape-7"
    assert control.asked == [("load_product", {"path": folder / "im.fits", "name": "escape-7"})]
    assert "Loaded as 'escape-7'" in browser.message.text()
    assert "press Check" in loop.message.text()
    window.update_timer.tick(force=True)
    assert loop.matrix.currentText() == "escape-7"


def test_a_run_without_a_matrix_cannot_be_loaded(browser: RunBrowser) -> None:
    click(browser, "model-psf-8")
    assert "this run has no matrix" in browser.load_button.toolTip()
    assert browser.replay_button.isEnabled()


def test_a_damaged_run_says_so(browser: RunBrowser) -> None:
    click(browser, "odd-10")
    assert browser.message.text().startswith("Damaged: its document is damaged (")
    assert browser.message.text().endswith("Load its matrix as a file.")
    assert not browser.load_button.isEnabled()
    QTest.keyClicks(browser.filter, "damaged")
    assert shown(browser) == ["odd-13", "odd-12", "odd-11", "odd-10"]


def test_files_are_chosen_in_the_run_folder(
    browser: RunBrowser, window: MainWindow, runs: Path, control: ScriptedControl,
    monkeypatch: pytest.MonkeyPatch, qtbot: QtBot,
) -> None:  # fmt: skip
    folders: list[str] = []

    def choose(*arguments: str) -> tuple[str, str]:
        folders.append(arguments[2])
        return str(runs / "some.fits") if len(folders) == 1 else "", ""

    monkeypatch.setattr(QFileDialog, "getOpenFileName", choose)
    monkeypatch.setattr(QFileDialog, "getExistingDirectory", lambda *words: choose(*words)[0])
    QTest.mouseClick(browser.file_button, Qt.MouseButton.LeftButton)
    qtbot.waitUntil(lambda: control.verbs == ["load_product"])
    window.replay.ask_product()
    window.replay.ask_run()
    assert folders == [str(runs)] * 3


def test_the_buttons_follow_the_state_and_the_message_stays(
    browser: RunBrowser, window: MainWindow, source: ScriptedSource, qtbot: QtBot
) -> None:
    click(browser, "escape-7")
    holder = source.state.lease
    source.change(lease=None)
    window.update_timer.tick(force=True)
    assert "take control first" in browser.load_button.toolTip()
    source.change(lease=holder)
    window.update_timer.tick(force=True)
    QTest.mouseClick(browser.load_button, Qt.MouseButton.LeftButton)
    qtbot.waitUntil(lambda: "Loaded as 'escape-7'" in browser.message.text())
    window.update_timer.tick(force=True)
    assert "Loaded as 'escape-7'" in browser.message.text()
