"""The loop panel, with key presses, clicks and the wheel: edit, check, apply, close."""

from __future__ import annotations

import threading
from collections.abc import Callable

import pytest
from PySide6.QtCore import QLocale, QPoint, QPointF, Qt
from PySide6.QtGui import QWheelEvent
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QApplication, QStyle, QStyleOptionSpinBox, QWidget
from pytestqt.qtbot import QtBot
from scripted import ScriptedControl, ScriptedSource, running

from escape_gui.client.session import EmptySource, Session
from escape_gui.main_window import MainWindow
from escape_gui.panels.loop import LoopPanel
from escape_gui.widgets.controls import HOLD_MS
from escape_gui.widgets.inputs import NumberBox
from escape_hw.remote.state import LoopState, Phase

OPEN = LoopState(matrix="escape", gain=0.4, leak=0.02, dropped_modes=3, n_modes=80)


@pytest.fixture
def window(make_window: Callable[..., MainWindow]) -> MainWindow:
    return make_window((LoopPanel,))


@pytest.fixture
def loop(window: MainWindow) -> LoopPanel:
    panel = window.panels["loop"]
    assert isinstance(panel, LoopPanel)
    return panel


class Typist:
    """Types into the fields while the state changes five times a second."""

    def __init__(self, window: MainWindow, source: ScriptedSource) -> None:
        self.window, self.source = window, source

    def new_state(self, **loop: object) -> None:
        self.source.change(loop=self.source.state.loop.model_copy(update=loop))
        self.window.update_timer.tick(force=True)

    def type(self, field: NumberBox, text: str) -> None:
        field.setFocus()
        field.selectAll()
        for letter in text:
            QTest.keyClicks(field, letter)
            self.new_state()


@pytest.fixture
def typist(window: MainWindow, source: ScriptedSource) -> Typist:
    return Typist(window, source)


def wheel(widget: QWidget, down: int) -> None:
    """Turn the wheel over a widget."""
    place = QPointF(widget.rect().center())
    event = QWheelEvent(
        place, QPointF(widget.mapToGlobal(place.toPoint())), QPoint(), QPoint(0, -120 * down),
        Qt.MouseButton.NoButton, Qt.KeyboardModifier.NoModifier, Qt.ScrollPhase.NoScrollPhase, False,
    )  # fmt: skip
    QApplication.sendEvent(widget, event)


def test_a_typed_gain_is_kept_from_the_first_key(
    typist: Typist, loop: LoopPanel, control: ScriptedControl, qtbot: QtBot
) -> None:
    typist.type(loop.gain, "0.55")
    assert loop.gain.text() == "0.55"
    typist.new_state(leak=0.03)
    assert (loop.gain.value(), loop.leak.value()) == (0.55, 0.03), "other fields follow the state"
    assert "press Check first" in loop.apply_button.toolTip()
    QTest.keyClick(loop.gain, Qt.Key.Key_Return)
    assert loop.message.text() == "Checked: gain 0.425 → 0.55"
    typist.new_state()
    qtbot.mouseClick(loop.apply_button, Qt.MouseButton.LeftButton)
    qtbot.waitUntil(lambda: loop.message.text() == "Applied: gain 0.425 → 0.55")
    assert control.asked == [("set_loop", {"gain": 0.55})]


def test_a_matrix_is_chosen_with_the_keyboard(
    typist: Typist, loop: LoopPanel, control: ScriptedControl, qtbot: QtBot
) -> None:
    assert loop.matrix.currentText() == "escape"
    loop.matrix.setFocus()
    QTest.keyClick(loop.matrix, Qt.Key.Key_Down)
    typist.new_state()
    assert loop.matrix.currentText() == "docrime", "the choice does not snap back"
    qtbot.mouseClick(loop.check_button, Qt.MouseButton.LeftButton)
    typist.new_state()
    qtbot.mouseClick(loop.apply_button, Qt.MouseButton.LeftButton)
    qtbot.waitUntil(lambda: control.asked == [("set_loop", {"matrix": "docrime"})])


def apply_leak(typist: Typist, loop: LoopPanel, qtbot: QtBot) -> None:
    """Type a leak of 0.05, check and apply it."""
    typist.type(loop.leak, "0.05")
    loop.check()
    loop.apply()
    qtbot.waitUntil(lambda: "Applied" in loop.message.text())


def test_the_result_stays_until_the_next_edit(
    typist: Typist, loop: LoopPanel, control: ScriptedControl, qtbot: QtBot
) -> None:
    apply_leak(typist, loop, qtbot)
    for _ in range(3):
        typist.new_state(leak=0.05)
    assert "Applied" in loop.message.text()
    assert loop.leak.value() == 0.05
    typist.type(loop.leak, "0.0")
    assert "Applied" not in loop.message.text()


def test_the_result_goes_when_the_loop_is_opened(
    typist: Typist, loop: LoopPanel, control: ScriptedControl, qtbot: QtBot
) -> None:
    apply_leak(typist, loop, qtbot)
    # A further key reverts nothing.
    assert loop.window().focusWidget() is loop.check_button
    typist.new_state(closed=False)
    assert loop.message.text() == ""


@pytest.mark.parametrize(
    ("field", "text", "message"),
    [
        ("gain", "3", "gain 3 is out of range: above 0 to 2"),
        ("gain", "0", "gain 0 is out of range: above 0 to 2"),
        ("gain", "-1", "gain -1 is out of range"),
        ("leak", "1.5", "leak 1.5 is out of range: 0 to 1"),
        ("dropped_modes", "94", "94 of 94 leaves none to control"),
    ],
)
def test_a_value_out_of_range_is_reported(
    field: str, text: str, message: str, typist: Typist, loop: LoopPanel
) -> None:
    box = loop.editors[field]
    assert isinstance(box, NumberBox)
    typist.type(box, text)
    assert message in loop.message.text()
    QTest.keyClick(box, Qt.Key.Key_Return)
    assert message in loop.message.text()
    typist.new_state()
    assert not loop.apply_button.isEnabled()


def test_revert_discards_the_edits(typist: Typist, loop: LoopPanel, qtbot: QtBot) -> None:
    typist.type(loop.leak, "0.1")
    typist.type(loop.gain, "0.7")
    typist.new_state(gain=0.6)
    assert loop.current["gain"].text() == "0.6000"
    qtbot.mouseClick(loop.revert_button, Qt.MouseButton.LeftButton)
    assert (loop.leak.value(), loop.gain.value()) == (0.026, 0.6)


def test_the_wheel_edits_only_a_field_with_the_focus(loop: LoopPanel, typist: Typist) -> None:
    loop.check_button.setFocus()
    for field in (loop.gain, loop.leak, loop.dropped_modes, loop.matrix):
        wheel(field, 1)
    assert not loop.message.text()
    assert (loop.gain.value(), loop.matrix.currentText()) == (0.425, "escape")
    loop.gain.setFocus()
    wheel(loop.gain, 1)
    assert loop.gain.value() == pytest.approx(0.375)


def test_the_buttons_of_a_field_are_drawn_and_stay_in_range(loop: LoopPanel, qtbot: QtBot) -> None:
    option = QStyleOptionSpinBox()
    loop.gain.initStyleOption(option)
    style, control = loop.gain.style(), QStyle.ComplexControl.CC_SpinBox
    up = style.subControlRect(control, option, QStyle.SubControl.SC_SpinBoxUp, loop.gain)
    assert up.width() >= 12
    for _ in range(60):
        qtbot.mouseClick(loop.gain, Qt.MouseButton.LeftButton, pos=up.center())
    assert loop.gain.value() == 2.0
    assert "0 to 2" in loop.gain.toolTip()


@pytest.mark.usefixtures("short_hold")
def test_closing_needs_a_held_button_and_shows_its_values(
    loop: LoopPanel, source: ScriptedSource, window: MainWindow, control: ScriptedControl, qtbot: QtBot
) -> None:
    assert "the loop is closed" in loop.close_button.toolTip()
    source.change(phase=Phase.IDLE, loop=OPEN)
    window.update_timer.tick(force=True)
    assert loop.closing_values.text() == "Closes with matrix 'escape', gain 0.4, leak 0.02, 3 dropped modes."
    qtbot.mouseClick(loop.close_button, Qt.MouseButton.LeftButton)
    qtbot.wait(50)
    assert control.asked == []
    qtbot.mousePress(loop.close_button, Qt.MouseButton.LeftButton)
    qtbot.waitUntil(lambda: bool(control.asked), timeout=20 * HOLD_MS)
    qtbot.mouseRelease(loop.close_button, Qt.MouseButton.LeftButton)
    assert control.asked == [("close_loop", {"args": ("escape", 0.4, 0.02, 3)})]


@pytest.mark.usefixtures("short_hold")
def test_only_checked_values_close_the_loop(
    loop: LoopPanel, source: ScriptedSource, typist: Typist, control: ScriptedControl, qtbot: QtBot
) -> None:
    source.change(phase=Phase.IDLE, loop=OPEN)
    typist.type(loop.gain, "0.3")
    assert not loop.close_button.isEnabled()
    assert "press Check first" in loop.close_button.toolTip()
    assert not loop.closing_values.isVisible()
    qtbot.mouseClick(loop.check_button, Qt.MouseButton.LeftButton)
    typist.new_state()
    assert "gain 0.3" in loop.closing_values.text()
    qtbot.keyPress(loop.close_button, Qt.Key.Key_Return)
    qtbot.waitUntil(lambda: control.verbs == ["close_loop"], timeout=20 * HOLD_MS)
    qtbot.keyRelease(loop.close_button, Qt.Key.Key_Return)
    assert control.asked[0][1] == {"args": ("escape", 0.3, 0.02, 3)}


@pytest.mark.parametrize("language", ["en_US", "de_DE", "ar_EG"])
@pytest.mark.parametrize("typed", ["0.05", "0,05"])
def test_numbers_have_a_decimal_point_in_every_language(
    language: str, typed: str, make_window: Callable[..., MainWindow], source: ScriptedSource
) -> None:
    source.change(loop=OPEN)
    before = QLocale()
    QLocale.setDefault(QLocale(language))
    try:
        window = make_window((LoopPanel,))
        loop = window.panels["loop"]
        assert isinstance(loop, LoopPanel)
        assert loop.gain.text() == "0.4000"
        Typist(window, source).type(loop.leak, typed)
        assert loop.leak.text() == "0.05"
        assert loop.edit.leak == 0.05
        QTest.keyClick(loop.leak, Qt.Key.Key_Return)
        assert loop.message.text() == "Checked: leak 0.02 → 0.05"
    finally:
        QLocale.setDefault(before)


def test_setpoints_outlast_the_engine_and_the_connection_but_not_the_system(
    typist: Typist, loop: LoopPanel, window: MainWindow, source: ScriptedSource, session: Session,
    control: ScriptedControl, qtbot: QtBot,
) -> None:  # fmt: skip
    source.change(phase=Phase.IDLE, loop=OPEN)
    window.update_timer.tick(force=True)
    loop.matrix.setFocus()
    QTest.keyClick(loop.matrix, Qt.Key.Key_End)
    loop.matrix.activated.emit(loop.matrix.currentIndex())
    assert loop.matrix.currentText() == "docrime"
    typist.type(loop.gain, "0.31")
    loop.check()
    source.fail("the engine died")
    source.change(engine_pid=0)
    window.update_timer.tick(force=True)
    source.change(engine_pid=12, phase=Phase.STARTING, fault=None, loop=LoopState())
    window.update_timer.tick(force=True)
    source.change(phase=Phase.IDLE)
    window.update_timer.tick(force=True)
    assert (loop.gain.value(), loop.matrix.currentText()) == (0.31, "docrime")
    assert loop.message.text() == "Edited before; press Check."
    assert "press Check first" in loop.close_button.toolTip()
    session.set_source(EmptySource(), None)
    window.update_timer.tick(force=True)
    session.set_source(source, control)
    window.update_timer.tick(force=True)
    assert (loop.gain.value(), loop.matrix.currentText()) == (0.31, "docrime")
    # Another bench has its own values.
    other = ScriptedSource(running(system="maps-nir", phase=Phase.IDLE, loop=OPEN))
    session.set_source(other, control)
    window.update_timer.tick(force=True)
    assert (loop.gain.value(), loop.matrix.currentText()) == (0.4, "escape")
    assert loop.message.text() == ""


def test_what_is_typed_while_the_server_works_stays(
    typist: Typist, loop: LoopPanel, control: ScriptedControl, qtbot: QtBot
) -> None:
    answer = threading.Event()
    control.set_loop = lambda **changes: answer.wait(10)
    typist.type(loop.gain, "0.35")
    QTest.keyClick(loop.gain, Qt.Key.Key_Return)
    typist.new_state()
    QTest.mouseClick(loop.apply_button, Qt.MouseButton.LeftButton)
    typist.type(loop.leak, "0.01")
    answer.set()
    qtbot.waitUntil(lambda: "Applied: gain 0.425 → 0.35" in loop.message.text())
    typist.new_state(gain=0.35)
    assert (loop.gain.value(), loop.leak.value()) == (0.35, 0.01)
    assert loop.message.text().endswith("Edited since; press Check.")
    assert "press Check first" in loop.apply_button.toolTip()
