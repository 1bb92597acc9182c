"""The window itself: safety buttons, band, layout, looks, and what it costs."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from gui_windows import dispose, settle, shown
from PySide6.QtCore import QPoint, Qt
from PySide6.QtWidgets import QAbstractButton, QAbstractSpinBox, QApplication, QComboBox, QLineEdit, QTabBar
from pytestqt.qtbot import QtBot
from scripted import ScriptedControl, ScriptedSource

from escape_gui.band import Band
from escape_gui.main_window import MainWindow
from escape_gui.session import NoSource, Session
from escape_gui.settings import Settings, load_settings
from escape_gui.widgets.picture import Picture
from escape_gui.workspaces import WORKSPACES
from escape_hw.remote.source import Source
from escape_hw.remote.state import Ended, Finish, Health

MakeWindow = Callable[..., MainWindow]


def places(band: Band) -> list[QPoint]:
    return [button.mapTo(band.window(), QPoint(0, 0)) for button in (band.open_button, band.flatten_button)]


def test_safety_buttons_never_move(window: MainWindow, source: ScriptedSource, qapp: QApplication) -> None:
    where = places(window.band)
    for one in WORKSPACES:
        window.show_workspace(one.name)
        source.change(rates=source.state.rates.model_copy(update={"lost": 999999, "frame_hz": 9999.9}))
        source.change(
            lease=source.state.lease.model_copy(update={"client": "f" * 16, "name": "somebody else"})
        )
        window.refresh()
        qapp.processEvents()
        assert places(window.band) == where
    source.fail()
    window.refresh()
    qapp.processEvents()
    assert places(window.band) == where


def test_safety_keys_work_from_everywhere(
    window: MainWindow, control: ScriptedControl, qtbot: QtBot, qapp: QApplication
) -> None:
    window.panels["log"].search.setFocus()
    qtbot.keyClick(
        window.panels["log"].search,
        Qt.Key.Key_O,
        Qt.KeyboardModifier.ControlModifier | Qt.KeyboardModifier.ShiftModifier,
    )
    qtbot.waitUntil(lambda: control.verbs == ["open_loop"])
    window.toggle_key_map()
    qtbot.keyClick(
        window.overlay, Qt.Key.Key_F, Qt.KeyboardModifier.ControlModifier | Qt.KeyboardModifier.ShiftModifier
    )
    qtbot.waitUntil(lambda: control.verbs == ["open_loop", "flatten"])
    qtbot.keyClick(window.overlay, Qt.Key.Key_Escape)
    assert not window.overlay.isVisible()


def test_the_band_says_what_it_is(small_window: MainWindow, source: ScriptedSource) -> None:
    window = small_window
    strip = window.band.strip
    assert strip.text().startswith("SIMULATED")
    assert strip.width() == window.width()
    source.change(simulated=False)
    window.refresh()
    assert strip.text() == "HARDWARE · razor-shwfs"
    source.connected = False
    window.refresh()
    assert strip.text().startswith("NOT CONNECTED")
    assert window.toasts.notes[-1].title == "Server lost"
    window.context.session.use(source, None)
    window.refresh()
    assert strip.text().startswith("REPLAY")


def test_a_fault_stays_until_it_is_cleared(
    small_window: MainWindow, source: ScriptedSource, control: ScriptedControl
) -> None:
    window = small_window
    assert not window.fault_bar.isVisible()
    source.fail("no frames for 0.5 s")
    window.refresh()
    assert window.fault_bar.isVisible()
    assert "no frames for 0.5 s" in window.fault_bar._text.text()
    assert "cable" in window.fault_bar._text.text()
    assert window.toasts.notes[-1].title == "Fault, mirror made safe"
    source.change(fault=None)
    window.refresh()
    assert not window.fault_bar.isVisible()


def test_the_end_of_a_run_is_told(small_window: MainWindow, source: ScriptedSource) -> None:
    source.change(last=Ended(id=1, name="escape", finish=Finish.FAILED, message="too dark", folder="/runs/2"))
    small_window.refresh()
    note = small_window.toasts.notes[-1]
    assert (note.title, note.text) == ("escape failed", "too dark\n/runs/2")
    note.shut.click()
    assert small_window.toasts.notes == []


def test_a_refused_request_is_told(small_window: MainWindow, control: ScriptedControl, qtbot: QtBot) -> None:
    control.refuse = "ben has control since 20:00"
    small_window.actions_by_name["give_back"].trigger()
    qtbot.waitUntil(lambda: bool(small_window.toasts.notes))
    note = small_window.toasts.notes[-1]
    assert (note.title, note.text) == ("Could not give control back", "ben has control since 20:00")


def test_hidden_panels_cost_nothing(window: MainWindow, source: ScriptedSource) -> None:
    for dock in window.docks.values():
        dock.hide()
    settle()
    source.reads = 0
    window.ticker.tick(everything=True)
    assert source.reads == 0
    window.docks["camera"].show()
    QApplication.processEvents()
    window.ticker.tick(everything=True)
    assert source.reads == 2


def test_a_tab_behind_another_costs_nothing(window: MainWindow, source: ScriptedSource) -> None:
    """Log in front of Latency, Image in front of Mirror."""
    window.docks["log"].raise_()
    window.docks["psf"].raise_()
    QApplication.processEvents()
    source.reads = 0
    window.ticker.tick(everything=True)
    seen = {"camera": 2, "psf": 2}
    assert source.reads == sum(seen.values())


def test_a_broken_panel_does_not_stop_the_others(
    window: MainWindow, source: ScriptedSource, caplog: pytest.LogCaptureFixture
) -> None:
    source.push("psf", source.streams["psf"].data.ravel())
    window.ticker.tick(everything=True)
    assert list(window.ticker.broken) == ["psf"]
    assert window.panels["psf"].is_empty
    assert "panel 'psf' failed" in caplog.text
    source.push_all(1)
    window.ticker.tick(everything=True)
    assert window.panels["camera"].health is Health.OK
    # Another source gives it another chance.
    window.context.session.use(source, None)
    window.ticker.tick(everything=True)
    assert window.ticker.broken == {}


def test_frozen_panels_hold_but_the_band_goes_on(small_window: MainWindow, source: ScriptedSource) -> None:
    window = small_window
    window.toggle_freeze()
    before = window.panels["camera"].picture.data
    source.push_all(2)
    source.change(rates=source.state.rates.model_copy(update={"frame_hz": 123.4}))
    window.ticker.tick(everything=True)
    assert window.panels["camera"].picture.data is before
    assert window.band.readouts["rate"].text == "123.4"


def test_layout_and_look_are_remembered(make_window: MakeWindow, tmp_path: Path) -> None:
    store = tmp_path / "gui.json"
    window = make_window()
    window.docks["log"].close()
    window.show_workspace("align")
    window.toggle_theme()
    window.step_letters(+1)
    window.close()
    settings, warnings = load_settings(store)
    assert warnings == ()
    window = make_window(settings=settings)
    assert window.workspace.name == "align"
    assert (window.context.theme.shade, window.context.theme.scale) == ("light", 1.1)
    assert window.docks["camera"].isVisible()
    window.show_workspace("operate")
    assert window.docks["performance"].isVisible()
    assert not window.docks["log"].isVisible()


def test_a_layout_of_another_time_is_dropped(make_window: MakeWindow) -> None:
    settings = Settings(layouts={"operate": "AAAA"}, geometry="%%%", workspace="gone")
    window = make_window(settings=settings)
    assert window.workspace.name == "operate"
    assert window.docks["camera"].isVisible()


def test_everything_can_be_reached_and_named(window: MainWindow) -> None:
    kinds = (QAbstractButton, QAbstractSpinBox, QComboBox, QLineEdit, QTabBar, Picture)
    nameless, deaf = [], []
    for kind in kinds:
        for widget in window.findChildren(kind):
            # Qt's own: the tabs of docks behind each other, arrows of menus.
            if widget.parent() is window or widget.objectName().startswith("qt_"):
                continue
            if isinstance(widget.parent(), QAbstractSpinBox | QComboBox | QTabBar | QLineEdit):
                continue
            text = getattr(widget, "text", lambda: "")()
            if not (widget.accessibleName() or text or widget.toolTip()):
                nameless.append(widget)
            if widget.focusPolicy() == Qt.FocusPolicy.NoFocus and not isinstance(widget, QTabBar):
                deaf.append((widget, widget.accessibleName()))
    assert nameless == []
    assert deaf == []


@pytest.mark.parametrize("scale", [0.8, 1.0, 1.4])
def test_nothing_of_the_band_is_cut_off(make_window: MakeWindow, scale: float) -> None:
    window = make_window((), Settings(font_scale=scale))
    window.resize(round(1280 * max(scale, 1)), 800)
    QApplication.processEvents()
    band = window.band
    for widget in (*band.readouts.values(), band.phase, band.loop, band.light, band.control):
        assert widget.width() >= widget.sizeHint().width()
        assert widget.geometry().right() < band.open_button.geometry().left()


def test_a_window_without_a_source_starts(tmp_path: Path) -> None:
    session = Session()
    quiet: Source = NoSource()
    assert not quiet.connected
    window = shown(session, tmp_path / "gui.json")
    assert window.panels["camera"].is_empty
    window.refresh()
    assert window.band.strip.text().startswith("NOT CONNECTED")
    dispose(window)
    session.close()
