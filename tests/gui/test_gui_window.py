"""The main window: safety buttons, header, layout, theme, cost of hidden panels."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from gui_windows import dispose, settle, show_window
from PySide6.QtCore import QPoint, Qt, QTimer
from PySide6.QtTest import QTest
from PySide6.QtWidgets import (
    QAbstractButton,
    QAbstractSpinBox,
    QApplication,
    QComboBox,
    QLabel,
    QLineEdit,
    QTabBar,
)
from pytestqt.qtbot import QtBot
from scripted import LEASE, ScriptedControl, ScriptedSource

from escape_gui.client.alarms import LimitMonitor
from escape_gui.client.session import EmptySource, Session
from escape_gui.main_window import MainWindow
from escape_gui.panels.base import ENGINE_ENDED_TEXT
from escape_gui.panels.camera import CameraPanel
from escape_gui.panels.log import LogPanel
from escape_gui.panels.loop import LoopPanel
from escape_gui.panels.mirror import MirrorPanel
from escape_gui.panels.performance import PerformancePanel
from escape_gui.panels.procedure import ProcedurePanel
from escape_gui.panels.psf import PsfPanel
from escape_gui.settings import Settings, load_settings
from escape_gui.widgets.controls import Level
from escape_gui.widgets.images import ImageViewer
from escape_gui.window.docks import WORKSPACES
from escape_gui.window.header import HeaderBar
from escape_gui.window.notifications import DISPLAY_MS
from escape_hw.config.loader import load_system
from escape_hw.remote.source import DataSource
from escape_hw.remote.state import (
    DeviceHealth,
    Finish,
    FinishedRun,
    FrameCounters,
    Phase,
    ProcedureEntry,
    ProcedureParameter,
    RecordingState,
)
from escape_hw.server.engine.procedures import ProcedureRegistry

MakeWindow = Callable[..., MainWindow]


def button_positions(header: HeaderBar) -> list[QPoint]:
    return [
        button.mapTo(header.window(), QPoint(0, 0)) for button in (header.open_button, header.flatten_button)
    ]


def test_safety_buttons_never_move(window: MainWindow, source: ScriptedSource, qapp: QApplication) -> None:
    positions = button_positions(window.header)
    for one in WORKSPACES:
        window.show_workspace(one.name)
        source.change(rates=source.state.rates.model_copy(update={"lost": 999999, "frame_hz": 9999.9}))
        source.change(
            lease=source.state.lease.model_copy(update={"client": "f" * 16, "name": "somebody else"})
        )
        window.refresh()
        qapp.processEvents()
        assert button_positions(window.header) == positions
    source.fail()
    window.refresh()
    qapp.processEvents()
    assert button_positions(window.header) == positions


def test_safety_keys_work_from_everywhere(
    small_window: MainWindow, control: ScriptedControl, qtbot: QtBot, qapp: QApplication
) -> None:
    window = small_window
    window.panels["log"].search.setFocus()
    qtbot.keyClick(
        window.panels["log"].search,
        Qt.Key.Key_O,
        Qt.KeyboardModifier.ControlModifier | Qt.KeyboardModifier.ShiftModifier,
    )
    qtbot.waitUntil(lambda: control.verbs == ["open_loop"])
    window.toggle_keyboard_table()
    qtbot.keyClick(
        window.overlay, Qt.Key.Key_F, Qt.KeyboardModifier.ControlModifier | Qt.KeyboardModifier.ShiftModifier
    )
    qtbot.waitUntil(lambda: control.verbs == ["open_loop", "flatten"])
    qtbot.keyClick(window.overlay, Qt.Key.Key_Escape)
    assert not window.overlay.isVisible()


def test_the_banner_states_the_kind_of_source(small_window: MainWindow, source: ScriptedSource) -> None:
    window = small_window
    connection_banner = window.header.connection_banner
    assert connection_banner.text().startswith("SIMULATED")
    assert connection_banner.width() == window.width()
    source.change(simulated=False)
    window.refresh()
    assert connection_banner.text() == "HARDWARE · razor-shwfs"
    source.connected = False
    window.refresh()
    assert connection_banner.text().startswith("NOT CONNECTED")
    assert window.notifications.notifications[-1].title == "Server lost"
    window.context.session.set_source(source, None)
    window.refresh()
    assert connection_banner.text().startswith("REPLAY")


def test_saturation_is_unknown_until_frames_arrive(small_window: MainWindow, source: ScriptedSource) -> None:
    indicator = small_window.header.saturation
    assert (indicator.level, indicator.text) == (Level.GOOD, "saturated 0.04 %")
    source.change(rates=FrameCounters())
    small_window.refresh()
    assert (indicator.level, indicator.text) == (Level.NEUTRAL, "saturated –")


def test_a_fault_stays_until_it_is_cleared(
    small_window: MainWindow, source: ScriptedSource, control: ScriptedControl
) -> None:
    window = small_window
    assert not window.fault_banner.isVisible()
    source.fail("no frames for 0.5 s")
    window.refresh()
    assert window.fault_banner.isVisible()
    assert "no frames for 0.5 s" in window.fault_banner.text.text()
    assert "cable" in window.fault_banner.text.text()
    assert window.notifications.notifications[-1].title == "Fault, mirror made safe"
    source.change(fault=None)
    window.refresh()
    assert not window.fault_banner.isVisible()


def test_the_end_of_a_run_is_notified(small_window: MainWindow, source: ScriptedSource) -> None:
    source.change(
        last_run=FinishedRun(id=1, name="escape", finish=Finish.FAILED, message="too dark", folder="/runs/2")
    )
    small_window.refresh()
    note = small_window.notifications.notifications[-1]
    assert (note.title, note.text) == ("escape failed", "too dark\n/runs/2")
    note.close_button.click()
    assert small_window.notifications.notifications == []


def test_control_that_another_window_takes_is_told(
    small_window: MainWindow, source: ScriptedSource, session: Session
) -> None:
    shown = small_window.notifications.notifications
    small_window.refresh()
    # After a reconnection, the connection before has control until it expires.
    mine = source.state.lease
    session.control.client = "e" * 16
    small_window.refresh()
    assert shown == []
    session.control.client = mine.client
    small_window.refresh()
    other = LEASE.model_copy(update={"client": "f" * 16, "name": "escape gui", "host": "dome", "pid": 815})
    source.change(lease=other)
    small_window.refresh()
    assert small_window.header.control.text == "another window has control"
    assert [one.title for one in shown] == ["Control taken"]
    assert "escape gui on dome (process 815) has taken control" in shown[0].text
    source.change(lease=mine)
    small_window.refresh()
    assert shown == []
    # Released by this window itself.
    source.change(lease=None)
    small_window.refresh()
    assert shown == []


def test_a_restarted_server_is_notified_also_without_a_lost_connection(
    small_window: MainWindow, source: ScriptedSource
) -> None:
    source.change(notes=("the previous server (process 7) did not end cleanly",))
    for _ in range(2):
        small_window.refresh()
    notes = [(one.title, one.text) for one in small_window.notifications.notifications]
    assert notes == [("Startup notice", "the previous server (process 7) did not end cleanly")]


def test_the_form_and_its_result_have_room(make_window: MakeWindow, source: ScriptedSource) -> None:
    """Nine arguments and five lines of result at 1280 x 800, and no unit at its field's edge."""
    parameters = (
        ProcedureParameter(name="poke", kind="float", default=0.01, unit="of full stroke"),
        ProcedureParameter(name="accuracy", kind="float", unit="% of a sub-aperture"),
        *(ProcedureParameter(name=f"number {k}", kind="int", default=k, unit="frame") for k in range(7)),
    )
    about = "Calibrates without a calibration source: DO-CRIME on the turbulence, then SPRINT. " * 2
    source.entries = (ProcedureEntry(name="escape", title="ESCAPE", help=about, parameters=parameters),)
    document = {
        "gain": 0.97,
        "residual_rms_nm": 44.0,
        "snr": {"min": 8.2},
        "strehl": {"peak": {"value": 0.4}},
    }
    source.change(
        last_run=FinishedRun(id=1, name="escape", finish=Finish.DONE, folder="/runs/2", document=document)
    )
    window = make_window(settings=Settings(workspace="calibrate"))
    panel = window.panels["procedure"]
    assert isinstance(panel, ProcedurePanel)
    for _ in range(3):
        window.update_timer.tick(force=True)
        QApplication.processEvents()
    fields = panel.form.fields.values()
    assert len(fields) == 9
    for widget in (*fields, panel.numbers, panel.start):
        assert widget.visibleRegion().boundingRect() == widget.rect(), widget.accessibleName()
    for field in fields:
        unit = next(
            one
            for one in field.parentWidget().findChildren(QLabel)
            if one.text() in ("of full stroke", "% sub-ap.", "frames")
            and one.geometry().center().y() - field.geometry().center().y() in (-1, 0, 1)
        )
        assert unit.geometry().left() - field.geometry().right() > 8
        assert field.width() >= 60


@pytest.mark.parametrize("system", [pytest.param("razor-shwfs", marks=pytest.mark.slow), "razor-pywfs"])
def test_the_forms_of_all_procedures_fit(
    make_window: MakeWindow, source: ScriptedSource, system: str
) -> None:
    """At 1280 x 800 no label is so long that fields or units are cut off."""
    source.entries = ProcedureRegistry(load_system(system)).entries
    window = make_window(settings=Settings(workspace="calibrate"))
    panel = window.panels["procedure"]
    assert isinstance(panel, ProcedurePanel)
    too_wide = []
    for k in range(panel.choice.count()):
        panel.choice.setCurrentIndex(k)
        window.update_timer.tick(force=True)
        QApplication.processEvents()
        area = panel.form._area
        if area.widget().minimumSizeHint().width() > area.viewport().width():
            too_wide.append(panel.choice.itemText(k))
    assert panel.choice.count() > 5
    assert too_wide == []


def test_a_notification_covers_no_panel(small_window: MainWindow, qtbot: QtBot, qapp: QApplication) -> None:
    window, notifications = small_window, small_window.notifications
    where = {name: dock.geometry() for name, dock in window.docks.items()}
    notifications.show_message(Level.ERROR, "Not saved", "the disk is full, " * 40 + "\n/runs/2")
    notifications.show_message(Level.GOOD, "Saved", "/runs/3")
    qapp.processEvents()
    bad, good = notifications.notifications
    assert good.isVisible()
    assert not bad.isVisible()
    assert {name: dock.geometry() for name, dock in window.docks.items()} == where
    assert window.statusBar().isAncestorOf(good)
    assert window.width() == 1280
    assert "/runs/2" in bad.toolTip()
    # Information disappears after a time; the error is shown again and stays.
    assert bad.findChildren(QTimer) == []
    (timer,) = good.findChildren(QTimer)
    assert (timer.interval(), timer.isSingleShot(), timer.isActive()) == (DISPLAY_MS, True, True)
    timer.start(1)
    qtbot.waitUntil(lambda: notifications.notifications == [bad], timeout=60_000)
    qapp.processEvents()
    assert bad.isVisible()
    assert bad.close_button.mapTo(window, QPoint(0, 0)).x() < window.width()


def test_a_refused_request_is_notified(
    small_window: MainWindow, control: ScriptedControl, qtbot: QtBot
) -> None:
    control.refuse = "ben has control since 20:00"
    small_window.actions_by_name["give_back"].trigger()
    qtbot.waitUntil(lambda: bool(small_window.notifications.notifications))
    note = small_window.notifications.notifications[-1]
    assert (note.title, note.text) == ("Could not release control", "ben has control since 20:00")


def test_hidden_panels_cost_nothing(window: MainWindow, source: ScriptedSource) -> None:
    for dock in window.docks.values():
        dock.hide()
    settle()
    source.reads = 0
    window.update_timer.tick(force=True)
    assert source.reads == 0
    window.docks["camera"].show()
    QApplication.processEvents()
    window.update_timer.tick(force=True)
    assert source.reads == 2


def test_a_tab_behind_another_costs_nothing(window: MainWindow, source: ScriptedSource) -> None:
    """Log in front of Latency, PSF in front of Mirror."""
    window.docks["log"].raise_()
    window.docks["psf"].raise_()
    QApplication.processEvents()
    source.reads = 0
    window.update_timer.tick(force=True)
    seen = {"camera": 2, "psf": 2}
    assert source.reads == sum(seen.values())


def test_a_broken_panel_does_not_stop_the_others(
    make_window: MakeWindow, source: ScriptedSource, caplog: pytest.LogCaptureFixture
) -> None:
    window = make_window((PsfPanel, CameraPanel))
    source.push("psf", source.streams["psf"].data.ravel())
    window.update_timer.tick(force=True)
    assert list(window.update_timer.failed_panels) == ["psf"]
    assert window.panels["psf"].shows_placeholder
    assert "panel 'psf' failed" in caplog.text
    source.push_all(1)
    window.update_timer.tick(force=True)
    assert window.panels["camera"].health is DeviceHealth.OK
    # A new source clears the failures.
    window.context.session.set_source(source, None)
    window.update_timer.tick(force=True)
    assert window.update_timer.failed_panels == {}


def test_frozen_panels_stop_but_the_header_updates(small_window: MainWindow, source: ScriptedSource) -> None:
    window = small_window
    assert not window.frozen_banner.isVisible()
    QTest.keyClick(window, Qt.Key.Key_X)
    assert window.frozen_banner.isVisible()
    assert "The panels show the data of " in window.frozen_banner.text.text()
    before = window.panels["camera"].image_view.data
    source.push_all(2)
    source.change(rates=source.state.rates.model_copy(update={"frame_hz": 123.4}))
    window.update_timer.tick(force=True)
    assert window.panels["camera"].image_view.data is before
    assert window.header.readouts["rate"].text == "123.4"
    QTest.mouseClick(window.frozen_banner.button, Qt.MouseButton.LeftButton)
    assert not window.frozen_banner.isVisible()
    assert not window.update_timer.frozen


def test_after_the_end_of_the_engine_nothing_stale_is_shown(
    make_window: MakeWindow, source: ScriptedSource
) -> None:
    window = make_window((CameraPanel, PsfPanel, MirrorPanel, LoopPanel, ProcedurePanel))
    source.fail("the engine (process 11) died")
    source.change(engine_pid=0, streams=())
    window.update_timer.tick(force=True)
    header = window.header
    assert header.phase.text == "fault"
    assert {one.text for one in header.readouts.values()} == {"–"}
    assert header.saturation.text == "saturated –"
    for name in ("camera", "psf", "mirror"):
        panel = window.panels[name]
        # The scripted streams still have samples; those of a server end with its engine.
        panel.reset()
        source.streams.clear()
        panel.refresh_from(source)
        assert panel.shows_placeholder
        assert panel._placeholder_label.text() == ENGINE_ENDED_TEXT
    window.show_workspace("calibrate")
    window.update_timer.tick(force=True)
    loop, procedure = window.panels["loop"], window.panels["procedure"]
    loop.on_state(source.state)
    loop.tick(source)
    assert {one.text() for one in loop.current.values()} == {"–"}
    assert not loop.modes.text()
    for button in (loop.close_button, procedure.start, procedure.check, window.actions_by_name["record"]):
        assert not button.isEnabled()
        assert "the engine has ended; clear the fault to start it again" in button.toolTip()
    assert window.actions_by_name["clear_fault"].isEnabled()


def test_notifications_are_closed_when_their_reason_has_passed(
    small_window: MainWindow, source: ScriptedSource
) -> None:
    window = small_window
    source.fail()
    window.refresh()
    source.connected = False
    window.refresh()
    titles = [one.title for one in window.notifications.notifications]
    assert titles == ["Fault, mirror made safe", "Server lost"]
    source.connected = True
    source.change(fault=None, phase=Phase.IDLE)
    window.refresh()
    assert window.notifications.notifications == []


def test_equal_log_lines_are_collapsed(small_window: MainWindow, source: ScriptedSource) -> None:
    window = small_window
    for _ in range(3):
        source.push_all(1)
    window.update_timer.tick(force=True)
    lines = window.panels["log"].text.toPlainText().splitlines()
    assert len(lines) == 2
    assert lines[-1].endswith("residual 44 nm (× 3)")


def test_layout_and_theme_are_saved(make_window: MakeWindow, tmp_path: Path) -> None:
    settings_path = tmp_path / "gui.json"
    panels = (CameraPanel, PerformancePanel, LogPanel)
    window = make_window(panels)
    window.docks["log"].close()
    window.show_workspace("align")
    window.toggle_theme()
    window.context.theme.step_scale(+1)
    window.close_without_question()
    settings, warnings = load_settings(settings_path)
    assert warnings == ()
    window = make_window(panels, settings)
    assert window.workspace.name == "align"
    assert (window.context.theme.palette_name, window.context.theme.scale) == ("light", 1.1)
    assert window.docks["camera"].isVisible()
    window.show_workspace("operate")
    assert window.docks["performance"].isVisible()
    assert not window.docks["log"].isVisible()


def test_an_invalid_layout_is_ignored(make_window: MakeWindow) -> None:
    settings = Settings(layouts={"operate": "AAAA"}, geometry="%%%", workspace="gone")
    window = make_window((CameraPanel, LogPanel), settings)
    assert window.workspace.name == "operate"
    assert window.docks["camera"].isVisible()


def test_everything_can_be_reached_and_named(window: MainWindow) -> None:
    kinds = (QAbstractButton, QAbstractSpinBox, QComboBox, QLineEdit, QTabBar, ImageViewer)
    nameless, unreachable, parents = [], [], []
    for kind in kinds:
        for widget in window.findChildren(kind):
            # Older versions of PySide6 lose a widget with its parent, unless that is kept.
            parents.append(parent := widget.parent())
            # Qt's own: the tabs of docks behind each other, arrows of menus, corners of tables.
            if parent is window or widget.objectName().startswith("qt_") or type(widget) is QAbstractButton:
                continue
            if isinstance(parent, QAbstractSpinBox | QComboBox | QTabBar | QLineEdit):
                continue
            text = getattr(widget, "text", lambda: "")()
            if not (widget.accessibleName() or text or widget.toolTip()):
                nameless.append(widget)
            if widget.focusPolicy() == Qt.FocusPolicy.NoFocus and not isinstance(widget, QTabBar):
                unreachable.append((widget, widget.accessibleName()))
    assert nameless == []
    assert unreachable == []


@pytest.mark.parametrize("scale", [0.8, 1.0, 1.4])
def test_nothing_of_the_header_is_cut_off(make_window: MakeWindow, scale: float) -> None:
    window = make_window((), Settings(font_scale=scale))
    window.resize(round(1280 * max(scale, 1)), 800)
    QApplication.processEvents()
    header = window.header
    for widget in (*header.readouts.values(), header.phase, header.loop, header.saturation, header.control):
        assert widget.width() >= widget.sizeHint().width()
        right = widget.mapTo(header, widget.rect().topRight()).x()
        assert widget.isVisible()
        assert right < header.open_button.geometry().left()


def test_a_window_without_a_source_starts(tmp_path: Path) -> None:
    session = Session()
    quiet: DataSource = EmptySource()
    assert not quiet.connected
    window = show_window(session, tmp_path / "gui.json", (CameraPanel, LoopPanel))
    assert window.panels["camera"].shows_placeholder
    header = window.header
    assert "escape serve SYSTEM" in header.connection_banner.text()
    assert "stale" not in header.connection_banner.text()
    assert {one.text for one in header.readouts.values()} == {"–"}
    for loop_indicator in (header.phase, header.loop, header.saturation, header.control):
        assert loop_indicator.level is Level.NEUTRAL
        assert loop_indicator.text.endswith("–")
    assert "escape serve SYSTEM" in window.panels["loop"]._placeholder_label.text()
    dispose(window)
    session.close()


@pytest.mark.parametrize("scale", [pytest.param(1.0, marks=pytest.mark.slow), 1.4])
def test_the_window_fits_a_small_screen(
    make_window: MakeWindow, source: ScriptedSource, scale: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """1366 x 768 with a task bar, also with all banners, of which the fault stays in view."""
    source.entries = (
        ProcedureEntry(
            name="escape",
            title="ESCAPE",
            help="Measures an interaction matrix. " * 12,
            parameters=tuple(ProcedureParameter(name=f"number {k}", kind="int", default=k) for k in range(9)),
        ),
    )
    ended = FinishedRun(id=1, name="escape", finish=Finish.DONE, message="all went well " * 20)
    source.change(last_run=ended)
    source.fail()
    window = make_window(settings=Settings(font_scale=scale))
    window.resize(1366, 700)
    monkeypatch.setattr("escape_gui.window.header.control_offer", lambda _: "No operator has control")
    monkeypatch.setattr(LimitMonitor, "unacknowledged", [f"alarm {k}" for k in range(5)])
    window.frozen_banner.show_frozen("12:00:00")
    window.server_banner.show_text("connected to a server")
    window.update_timer.tick(force=True)
    for one in WORKSPACES:
        window.show_workspace(one.name)
        QApplication.processEvents()
        window.update_timer.tick(force=True)
        QApplication.processEvents()
        assert window.minimumSizeHint().height() <= 700, one.name
        window.resize(round(1366 * scale), 700)
        assert window.height() == 700
        assert not window.fault_banner.visibleRegion().isEmpty()
        assert window.alarm_banner.isVisible()


def test_no_tab_bar_of_another_workspace_remains(make_window: MakeWindow) -> None:
    window = make_window()
    for one in (*WORKSPACES, *WORKSPACES):
        window.show_workspace(one.name)
        for _ in range(5):
            QApplication.processEvents()
            window.update_timer.tick(force=True)
        bars = window.findChildren(QTabBar, options=Qt.FindChildOption.FindDirectChildrenOnly)
        seen = {
            tuple(bar.tabText(k) for k in range(bar.count()))
            for bar in bars
            if bar.isVisible() and bar.count()
        }
        wanted = {
            tuple(window.docks[name].windowTitle() for name in cell.names)
            for column in one.columns
            for cell in column.cells
            if len(cell.names) > 1
        }
        assert seen == wanted, one.name


def test_no_error_makes_room_for_information(
    small_window: MainWindow, source: ScriptedSource, monkeypatch: pytest.MonkeyPatch, qtbot: QtBot
) -> None:
    monkeypatch.setattr("escape_gui.window.notifications.DISPLAY_MS", 1)
    notifications = small_window.notifications
    notifications.show_message(Level.ERROR, "Could not open the loop", "why")
    source.change(notes=("the previous server did not end cleanly", "run 3 can be resumed"))
    small_window.update_timer.tick(force=True)
    for number in range(4):
        notifications.show_message(Level.GOOD, "Saved", f"/runs/{number}")
    assert [one.title for one in notifications.notifications][:2] == [
        "Could not open the loop", "Startup notice",
    ]  # fmt: skip
    qtbot.waitUntil(lambda: len(notifications.notifications) == 2, timeout=60_000)
    assert notifications.notifications[1].text.splitlines() == list(source.state.notes)


def test_a_recording_that_fails_is_notified(small_window: MainWindow, source: ScriptedSource) -> None:
    source.change(recording=RecordingState(recording=True, path="/runs/1"))
    small_window.update_timer.tick(force=True)
    full = RecordingState(path="/runs/1", fault="94 MB free, below the limit of 268 MB; free some space")
    for _ in range(2):
        source.change(recording=full)
        small_window.update_timer.tick(force=True)
    (told,) = small_window.notifications.notifications
    assert (told.level, told.title) == (Level.ERROR, "Recording ended")
    assert told.text.startswith(full.fault)
