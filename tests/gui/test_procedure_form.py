"""The form of a procedure: what the operator entered is kept, and one click starts one run."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from gui_windows import dispose, refresh, show_window, until
from PySide6.QtCore import Qt
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QApplication, QComboBox, QLineEdit
from scripted import ScriptedControl, ScriptedSource
from test_calibrate_panels import PROCEDURES, RUNNING, press

from escape_gui.client.session import EmptySource, Session
from escape_gui.main_window import MainWindow
from escape_gui.panels.procedure import ProcedurePanel
from escape_gui.settings import Settings
from escape_gui.views.procedure_form import parse_value
from escape_hw.remote.state import Finish, FinishedRun, Phase, ProcedureParameter, ProductEntry


@pytest.fixture
def source() -> ScriptedSource:
    return idle_source()


def idle_source() -> ScriptedSource:
    """A server on which nothing runs."""
    source = ScriptedSource()
    source.entries = PROCEDURES
    source.change(phase=Phase.IDLE, products=matrices("first", "second"))
    return source


def matrices(*names: str) -> tuple[ProductEntry, ...]:
    return tuple(ProductEntry(name=name, kind="matrix", path=f"/{name}.fits") for name in names)


@pytest.fixture
def calibrate(session: Session, tmp_path: Path) -> Iterator[MainWindow]:
    window = show_window(session, tmp_path / "gui.json", (ProcedurePanel,), Settings(workspace="calibrate"))
    window.docks["procedure"].show()
    window.activateWindow()
    refresh(window)
    yield window
    dispose(window)


def type_into(panel: ProcedurePanel, name: str, text: str) -> None:
    """Replace the content of a field, with keys."""
    field = panel.form.fields[name]
    field.setFocus()
    assert isinstance(field, QLineEdit)
    field.selectAll()
    QTest.keyClicks(field, text)


def choose(box: QComboBox, text: str) -> None:
    """Choose an entry, with keys."""
    box.setFocus()
    QTest.keyClick(box, Qt.Key.Key_Home)
    for _ in range(box.findText(text)):
        QTest.keyClick(box, Qt.Key.Key_Down)
    assert box.currentText() == text


def fill_in(panel: ProcedurePanel) -> None:
    """Enter something into every kind of field."""
    type_into(panel, "frames", "200")
    type_into(panel, "snr", "12.5")
    for name, text in (("pokes", "anticorrelated"), ("closed_loop", "first")):
        field = panel.form.fields[name]
        assert isinstance(field, QComboBox)
        choose(field, text)
    QTest.keyClick(panel.form.fields["plain"], Qt.Key.Key_Space)


ENTERED = {"frames": 200, "snr": 12.5, "pokes": "anticorrelated", "plain": True, "closed_loop": "first"}


def test_a_replaced_connection_loses_no_argument(
    calibrate: MainWindow, session: Session, control: ScriptedControl
) -> None:
    panel = calibrate.panels["procedure"]
    choose(panel.choice, "Optical gains")
    choose(panel.form.fields["im"], "first")
    choose(panel.choice, "ESCAPE")
    fill_in(panel)
    assert panel.form.arguments() == ENTERED
    # The server is lost, another process of it is found, and later fetches its procedures.
    session.set_source(EmptySource(), None)
    refresh(calibrate)
    assert not panel.form.isVisible()
    again = idle_source()
    again.entries, again.state = (), again.state.model_copy(update={"engine_pid": 12, "products": ()})
    session.set_source(again, control)
    refresh(calibrate)
    again.entries = PROCEDURES
    refresh(calibrate)
    assert panel.choice.currentText() == "ESCAPE"
    again.change(products=matrices("first", "third"))
    refresh(calibrate)
    assert panel.form.isVisible()
    assert panel.form.arguments() == ENTERED
    until(panel.start.isEnabled, calibrate)
    assert control.asked[-1] == ("plan", {"procedure": "escape", "arguments": ENTERED})
    choose(panel.choice, "Optical gains")
    assert panel.form.arguments() == {"im": "first"}


def test_another_engine_loses_no_argument_and_no_focus(
    calibrate: MainWindow, source: ScriptedSource, control: ScriptedControl
) -> None:
    panel = calibrate.panels["procedure"]
    fill_in(panel)
    type_into(panel, "frames", "20")
    field = panel.form.fields["frames"]
    source.fail()
    source.change(engine_pid=0)
    refresh(calibrate)
    asked = len(control.asked)
    source.change(engine_pid=12, phase=Phase.STARTING, fault=None)
    refresh(calibrate)
    assert QApplication.focusWidget() is field
    QTest.keyClicks(field, "0")
    assert panel.form.arguments() == ENTERED
    assert not panel._timer.isActive(), "an engine that starts has no plan"
    assert len(control.asked) == asked
    source.change(phase=Phase.IDLE)
    until(panel.start.isEnabled, calibrate)


def test_another_server_gets_the_arguments_that_are_valid_there(
    calibrate: MainWindow, session: Session, control: ScriptedControl
) -> None:
    panel = calibrate.panels["procedure"]
    fill_in(panel)
    escape, gains = PROCEDURES
    frames, snr, *others = escape.parameters
    less = frames.model_copy(update={"high": 100.0, "default": 50})
    other = idle_source()
    other.entries = (gains, escape.model_copy(update={"parameters": (less, snr, *others[:-1])}))
    session.set_source(other, control)
    refresh(calibrate)
    assert panel.choice.currentText() == "ESCAPE"
    assert panel.form.arguments() == {"snr": 12.5, "pokes": "anticorrelated", "plain": True}
    assert panel.form.fields["frames"].text() == "50"
    assert "Entered before, but not valid here: Frames 200." in panel._description.text()
    # Back on the first server nothing is lost.
    session.set_source(idle_source(), control)
    refresh(calibrate)
    assert panel.form.arguments() == ENTERED
    assert "not valid" not in panel._description.text()


def test_another_procedure_loses_no_argument(calibrate: MainWindow) -> None:
    panel = calibrate.panels["procedure"]
    fill_in(panel)
    choose(panel.choice, "Optical gains")
    assert panel.form.arguments() == {"im": "second"}
    choose(panel.choice, "ESCAPE")
    assert panel.form.arguments() == ENTERED


def test_start_stays_disabled_until_the_run_is_in_the_state(
    calibrate: MainWindow, source: ScriptedSource, control: ScriptedControl
) -> None:
    panel = calibrate.panels["procedure"]
    source.change(last_run=FinishedRun(id=2, name="sensor", finish=Finish.DONE))
    until(panel.start.isEnabled, calibrate)
    press(panel.start)
    until(lambda: control.verbs[-1] == "start", calibrate)
    for _ in range(3):
        source.change()
        refresh(calibrate)
        assert not panel.start.isEnabled()
        assert "it is being started" in panel.start.toolTip()
        press(panel.start)
    source.change(phase=Phase.PROCEDURE, active_run=RUNNING)
    refresh(calibrate)
    assert "a procedure is running" in panel.start.toolTip()
    source.change(phase=Phase.IDLE, active_run=None)
    source.change(last_run=FinishedRun(id=3, name="escape", finish=Finish.DONE))
    until(panel.start.isEnabled, calibrate)
    assert control.verbs.count("start") == 1


def test_a_refused_start_can_be_repeated(
    calibrate: MainWindow, source: ScriptedSource, control: ScriptedControl
) -> None:
    panel = calibrate.panels["procedure"]
    until(panel.start.isEnabled, calibrate)
    control.refuse = "the devices are in use"
    press(panel.start)
    assert not panel.start.isEnabled()
    until(panel.start.isEnabled, calibrate)
    assert calibrate.notifications.notifications[-1].text == "the devices are in use"


def test_a_decimal_comma_is_refused_with_the_remedy() -> None:
    poke = ProcedureParameter(name="poke", kind="float", default=0.02, low=0.0, high=1.0)
    with pytest.raises(ValueError, match="'0,05' is no number; write a decimal point"):
        parse_value(poke, "0,05")
