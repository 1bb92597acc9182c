"""Settings of the cameras, and pokes of the mirror, with clicks and keys."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from gui_windows import click_pixel
from PySide6.QtCore import Qt
from PySide6.QtTest import QTest
from pytestqt.qtbot import QtBot
from scripted import ScriptedControl, ScriptedSource

from escape_gui.client.session import EmptySource
from escape_gui.main_window import MainWindow
from escape_gui.panels.camera import CameraPanel
from escape_gui.panels.mirror import MirrorPanel
from escape_gui.panels.modes import ModesPanel
from escape_gui.panels.psf import PsfPanel
from escape_gui.views.images import mask_from_rows
from escape_gui.widgets.controls import HOLD_MS
from escape_gui.window.actions import help_page
from escape_gui.window.camera_dialog import CameraDialog
from escape_gui.window.offsets_dialog import OffsetsDialog
from escape_hw.remote.state import ActiveRun, LoopState, Phase

MakeWindow = Callable[..., MainWindow]


@pytest.fixture
def idle(source: ScriptedSource) -> ScriptedSource:
    """A bench that is idle, loop open."""
    source.change(phase=Phase.IDLE, loop=LoopState(gain=0.4))
    return source


@pytest.fixture
def dialog(make_window: MakeWindow, idle: ScriptedSource, qtbot: QtBot) -> CameraDialog:
    """The settings of the sensor camera."""
    window = make_window((CameraPanel, PsfPanel))
    window.docks["camera"].show()
    panel = window.panels["camera"]
    assert isinstance(panel, CameraPanel)
    qtbot.mouseClick(panel.settings_button, Qt.MouseButton.LeftButton)
    dialog = window.camera_dialogs["wfs"]
    qtbot.waitUntil(lambda: dialog.fields["exposure_s"].value() == pytest.approx(1.9))
    return dialog


def type_into(dialog: CameraDialog, name: str, text: str) -> None:
    field = dialog.fields[name]
    field.setFocus()
    field.selectAll()
    QTest.keyClicks(field, text)


def test_an_exposure_is_typed_checked_and_applied(
    dialog: CameraDialog, control: ScriptedControl, qtbot: QtBot
) -> None:
    assert not dialog.apply_button.isEnabled()
    assert "press Check first" in dialog.apply_button.toolTip()
    type_into(dialog, "exposure_s", "0.8")
    QTest.keyClick(dialog.fields["exposure_s"], Qt.Key.Key_Return)
    qtbot.waitUntil(dialog.apply_button.isEnabled)
    assert control.verbs == ["check_camera", "check_camera"]
    assert "exposure_s → 0.0008" in dialog.message.text()
    type_into(dialog, "exposure_s", "0.7")
    assert not dialog.apply_button.isEnabled(), "an edit needs another check"
    qtbot.mouseClick(dialog.check_button, Qt.MouseButton.LeftButton)
    qtbot.waitUntil(dialog.apply_button.isEnabled)
    qtbot.mouseClick(dialog.apply_button, Qt.MouseButton.LeftButton)
    qtbot.waitUntil(lambda: "Applied" in dialog.message.text())
    assert ("set_camera", {"camera": "wfs", "exposure_s": pytest.approx(0.7e-3)}) in control.asked
    # The settings are read again after the message.
    qtbot.waitUntil(lambda: dialog.current["exposure_s"].text() == "0.7000")


def test_a_region_is_sent_as_a_whole_and_a_refusal_is_shown(
    dialog: CameraDialog, control: ScriptedControl, qtbot: QtBot
) -> None:
    control.refusal = "the loop is closed and would get no frames meanwhile; open it first"
    type_into(dialog, "height", "200")
    qtbot.mouseClick(dialog.check_button, Qt.MouseButton.LeftButton)
    qtbot.waitUntil(lambda: "Not now: the loop is closed" in dialog.message.text())
    assert control.asked[-1][1]["region"] == (0, 0, 400, 200)
    assert not dialog.apply_button.isEnabled()
    qtbot.mouseClick(dialog.revert_button, Qt.MouseButton.LeftButton)
    assert dialog.fields["height"].value() == 400


def test_a_value_out_of_range_is_reported_before_it_is_sent(
    dialog: CameraDialog, control: ScriptedControl, qtbot: QtBot
) -> None:
    type_into(dialog, "gain_db", "90")
    qtbot.mouseClick(dialog.check_button, Qt.MouseButton.LeftButton)
    assert dialog.message.text() == "Gain 90 is out of range: 0 to 48"
    assert control.verbs == ["check_camera"]


def test_dark_and_flat_are_measured_on_an_idle_bench(
    dialog: CameraDialog, control: ScriptedControl, idle: ScriptedSource, qtbot: QtBot
) -> None:
    qtbot.mouseClick(dialog.dark_button, Qt.MouseButton.LeftButton)
    qtbot.waitUntil(lambda: ("start", {"args": ("dark",)}) in control.asked)
    qtbot.mouseClick(dialog.blocked, Qt.MouseButton.LeftButton)
    qtbot.mouseClick(dialog.dark_button, Qt.MouseButton.LeftButton)
    qtbot.waitUntil(lambda: ("start", {"args": ("dark",), "blocked_by_hand": True}) in control.asked)
    idle.change(phase=Phase.LOOP)
    dialog.update_buttons()
    assert not dialog.flat_button.isEnabled()
    assert "not idle" in dialog.flat_button.toolTip()


# ---------------------------------------------------------------- pokes
@pytest.fixture
def window(make_window: MakeWindow, idle: ScriptedSource) -> MainWindow:
    return make_window((MirrorPanel,))


@pytest.fixture
def mirror(window: MainWindow) -> MirrorPanel:
    panel = window.panels["mirror"]
    assert isinstance(panel, MirrorPanel)
    panel.resize(420, 640)
    return panel


@pytest.mark.usefixtures("short_hold")
def test_an_actuator_is_poked_by_arming_clicking_and_holding(
    window: MainWindow, mirror: MirrorPanel, control: ScriptedControl, qtbot: QtBot
) -> None:
    click_pixel(mirror.image_view, 5, 5)
    assert control.verbs == [], "nothing happens before pokes are armed"
    assert not mirror.poke_button.isVisible()
    qtbot.mouseClick(mirror.arm_button, Qt.MouseButton.LeftButton)
    click_pixel(mirror.image_view, 5, 5)
    number = int(mirror._map.numbers[5, 5])
    assert mirror.poke_number.value() == number
    qtbot.waitUntil(lambda: f"actuator {number} at +0.05" in mirror.poke_text.text())
    window.update_timer.tick(force=True)
    qtbot.mouseClick(mirror.poke_button, Qt.MouseButton.LeftButton)
    assert "poke" not in control.verbs, "a click is not enough"
    with qtbot.waitSignal(mirror.poke_button.confirmed, timeout=10 * HOLD_MS):
        qtbot.mousePress(mirror.poke_button, Qt.MouseButton.LeftButton)
    qtbot.mouseRelease(mirror.poke_button, Qt.MouseButton.LeftButton)
    qtbot.waitUntil(lambda: "poke" in control.verbs)
    assert control.asked[-1] == ("poke", {"args": ("actuator", number, 0.05, 2.0)})
    # The next key is for no other widget when the button is disabled.
    assert window.focusWidget() is mirror.arm_button


def test_a_refused_poke_cannot_be_held(
    window: MainWindow, mirror: MirrorPanel, control: ScriptedControl, qtbot: QtBot
) -> None:
    control.refusal = "the limits of the mirror allow at most 0.4 of the stroke"
    qtbot.mouseClick(mirror.arm_button, Qt.MouseButton.LeftButton)
    mirror.poke_amplitude.setFocus()
    mirror.poke_amplitude.selectAll()
    QTest.keyClicks(mirror.poke_amplitude, "0.9")
    qtbot.waitUntil(lambda: "at most 0.4" in mirror.poke_text.text())
    window.update_timer.tick(force=True)
    assert not mirror.poke_button.isEnabled()


def test_pokes_are_disarmed_when_the_loop_closes_and_after_a_while(
    window: MainWindow, mirror: MirrorPanel, idle: ScriptedSource, qtbot: QtBot
) -> None:
    qtbot.mouseClick(mirror.arm_button, Qt.MouseButton.LeftButton)
    window.update_timer.tick(force=True)
    assert mirror.arm_button.isChecked()
    idle.change(phase=Phase.LOOP, loop=LoopState(closed=True))
    window.update_timer.tick(force=True)
    assert not mirror.arm_button.isChecked()
    assert "the loop is closed" in mirror.arm_button.toolTip()
    idle.change(phase=Phase.IDLE, loop=LoopState())
    window.update_timer.tick(force=True)
    qtbot.mouseClick(mirror.arm_button, Qt.MouseButton.LeftButton)
    mirror._armed_until = 0.0
    window.update_timer.tick(force=True)
    assert not mirror.arm_button.isChecked()


def test_disarming_ends_a_poke_that_is_held(
    window: MainWindow, mirror: MirrorPanel, idle: ScriptedSource, control: ScriptedControl, qtbot: QtBot
) -> None:
    qtbot.mouseClick(mirror.arm_button, Qt.MouseButton.LeftButton)
    idle.change(phase=Phase.PROCEDURE, active_run=ActiveRun(id=0, name="poke", arguments={}, stage="poke"))
    window.update_timer.tick(force=True)
    assert mirror.arm_button.isChecked(), "a poke of this window does not disarm"
    assert not mirror.poke_button.isEnabled()
    qtbot.mouseClick(mirror.arm_button, Qt.MouseButton.LeftButton)
    qtbot.waitUntil(lambda: "abort" in control.verbs)


def test_a_clicked_mode_is_chosen_while_pokes_are_armed(
    make_window: MakeWindow, idle: ScriptedSource, control: ScriptedControl, qtbot: QtBot
) -> None:
    window = make_window((MirrorPanel, ModesPanel))
    mirror, modes = window.panels["mirror"], window.panels["modes"]
    assert isinstance(mirror, MirrorPanel)
    assert isinstance(modes, ModesPanel)
    for dock in window.docks.values():
        dock.show()
    valid = mask_from_rows(idle.geometry_data.valid)
    idle.push("valid", valid.astype(np.uint8))
    idle.push("matrix", np.random.default_rng(0).normal(size=(2 * int(valid.sum()), 94)).astype(np.float32))
    window.update_timer.tick(force=True)
    modes.mosaic.choose(7)
    assert control.verbs == []
    qtbot.mouseClick(mirror.arm_button, Qt.MouseButton.LeftButton)
    modes.mosaic.choose(7)
    qtbot.waitUntil(lambda: "mode 8 at +0.05" in mirror.poke_text.text())
    assert mirror.poke_number.value() == 8
    # Modes count from 1, actuators from 0.
    mirror._choose("actuator", 0)
    qtbot.waitUntil(lambda: "actuator 0 at +0.05" in mirror.poke_text.text())
    mirror.poke_kind.buttons["mode"].click()
    qtbot.waitUntil(lambda: "mode 1 at +0.05" in mirror.poke_text.text())


def test_strokes_are_shown_in_nanometres_too(window: MainWindow, mirror: MirrorPanel) -> None:
    assert mirror.readouts["peak"].text == "0.4120"
    assert mirror.readouts["peak_nm"].text == f"{0.412 * 3500:.0f}"
    assert "nm" in mirror.scale.text()
    assert "as a fraction of its full stroke and in nanometres" in mirror.help
    assert "per cent of" not in help_page(mirror)


# ---------------------------------------------------------------- offsets
@pytest.fixture
def offsets(window: MainWindow, mirror: MirrorPanel, qtbot: QtBot) -> OffsetsDialog:
    qtbot.mouseClick(mirror.offsets_button, Qt.MouseButton.LeftButton)
    return window.offsets_dialog


def test_offsets_are_typed_applied_and_cleared(
    offsets: OffsetsDialog, control: ScriptedControl, qtbot: QtBot
) -> None:
    for name, text in (("tip", "25"), ("mode", "-12.5")):
        offsets.fields[name].setFocus()
        offsets.fields[name].selectAll()
        QTest.keyClicks(offsets.fields[name], text)
    qtbot.mouseClick(offsets.buttons["apply"], Qt.MouseButton.LeftButton)
    qtbot.waitUntil(lambda: offsets.message.text() == "Applied.")
    assert control.asked[-1][1]["terms"] == {"tip": 25.0, "mode 4": -12.5}
    assert offsets.current["tip"].text() == "25.0"
    qtbot.mouseClick(offsets.buttons["zero"], Qt.MouseButton.LeftButton)
    qtbot.waitUntil(lambda: control.asked[-1][1]["terms"] == {})
    assert offsets.fields["tip"].value() == 0


def test_references_and_flat_are_taken_from_the_present(
    offsets: OffsetsDialog, control: ScriptedControl, qtbot: QtBot
) -> None:
    assert offsets.references.text() == "Reference slopes: of the matrix"
    qtbot.mouseClick(offsets.buttons["present_slopes"], Qt.MouseButton.LeftButton)
    qtbot.waitUntil(lambda: offsets.references.text() == "Reference slopes: measured")
    qtbot.mouseClick(offsets.buttons["present_shape"], Qt.MouseButton.LeftButton)
    qtbot.waitUntil(lambda: offsets.flat.text() == "Flat: set")
    qtbot.mouseClick(offsets.buttons["clear_flat"], Qt.MouseButton.LeftButton)
    qtbot.waitUntil(lambda: offsets.flat.text() == "Flat: zero")


def test_offsets_are_saved_and_restored(
    offsets: OffsetsDialog, control: ScriptedControl, idle: ScriptedSource, qtbot: QtBot
) -> None:
    assert "give a name" in offsets.buttons["save"].toolTip()
    QTest.keyClicks(offsets.name, "m2 aligned")
    qtbot.mouseClick(offsets.buttons["save"], Qt.MouseButton.LeftButton)
    qtbot.waitUntil(lambda: offsets.saved.count() == 2)
    idle.change(offsets=control.offsets)
    offsets.update_buttons()
    offsets.saved.setCurrentText("night-1")
    qtbot.mouseClick(offsets.buttons["load"], Qt.MouseButton.LeftButton)
    qtbot.waitUntil(lambda: offsets.current["focus"].text() == "60.0")
    assert offsets.fields["mode"].value() == -20.0


def test_offsets_that_the_server_refuses_say_why(
    offsets: OffsetsDialog, control: ScriptedControl, idle: ScriptedSource, qtbot: QtBot
) -> None:
    control.refuse = "flat command rejected: 1.2 exceeds 1"
    qtbot.mouseClick(offsets.buttons["apply"], Qt.MouseButton.LeftButton)
    qtbot.waitUntil(lambda: "exceeds 1" in offsets.message.text())
    idle.change(phase=Phase.PROCEDURE, active_run=ActiveRun(id=5, name="docrime", arguments={}, stage=""))
    offsets.update_buttons()
    assert "a procedure is running" in offsets.buttons["apply"].toolTip()


def test_settings_are_read_as_soon_as_the_engine_is_ready(
    dialog: CameraDialog, control: ScriptedControl, idle: ScriptedSource, qtbot: QtBot
) -> None:
    dialog.reject()
    control.refuse = "the engine is starting"
    idle.change(phase=Phase.STARTING)
    dialog.open_settings()
    qtbot.waitUntil(lambda: dialog.message.text() == "the engine is starting")
    assert "not read yet" in dialog.check_button.toolTip()
    type_into(dialog, "exposure_s", "3")
    control.refuse = ""
    idle.change(phase=Phase.IDLE)
    dialog.update_buttons()
    qtbot.waitUntil(lambda: dialog.current["frame_rate_hz"].text() == "500.000")
    assert dialog.fields["exposure_s"].value() == 3, "what was typed stays"
    assert dialog.fields["frame_rate_hz"].value() == 500
    control.camera = control.camera.model_copy(update={"exposure_s": 1e-3})
    idle.change(engine_pid=12)
    dialog.update_buttons()
    qtbot.waitUntil(lambda: dialog.current["exposure_s"].text() == "1.0000")


def test_typed_offsets_stay_when_something_else_is_set(
    offsets: OffsetsDialog, control: ScriptedControl, idle: ScriptedSource, qtbot: QtBot
) -> None:
    tip = offsets.fields["tip"]
    tip.setFocus()
    tip.selectAll()
    QTest.keyClicks(tip, "50")
    qtbot.mouseClick(offsets.buttons["present_slopes"], Qt.MouseButton.LeftButton)
    qtbot.waitUntil(lambda: offsets.message.text() == "Applied.")
    assert (tip.value(), offsets.current["tip"].text()) == (50, "0.0")
    control.refuse = "beyond a limit"
    QTest.keyClick(tip, Qt.Key.Key_Return)
    qtbot.waitUntil(lambda: offsets.message.text() == "beyond a limit")
    control.refuse = ""
    qtbot.mouseClick(offsets.buttons["clear_slopes"], Qt.MouseButton.LeftButton)
    qtbot.waitUntil(lambda: offsets.message.text() == "Applied.")
    assert tip.value() == 50
    idle.change(offsets=control.offsets)
    offsets.update_buttons()
    qtbot.mouseClick(offsets.buttons["load"], Qt.MouseButton.LeftButton)
    qtbot.waitUntil(lambda: offsets.message.text().startswith("Restored"))
    assert (tip.value(), offsets.fields["focus"].value()) == (0, 60)


def test_without_a_server_a_dialog_says_so(offsets: OffsetsDialog, window: MainWindow) -> None:
    offsets._session.set_source(EmptySource(), None)
    camera = window.camera_dialogs["wfs"]
    camera.open_settings()
    assert camera.message.text() == "there is no server"
    QTest.keyClick(offsets.fields["tip"].lineEdit(), Qt.Key.Key_Return)
    assert offsets.message.text() == "there is no server"
