"""Creates the images of the operator's tutorial: ``pytest -m screenshots``; takes some minutes."""

from __future__ import annotations

from pathlib import Path

import pytest
import serving
from gui_windows import click_pixel
from PIL import Image
from PySide6.QtCore import Qt
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QWidget
from whole_run import Operator, operating

from escape_hw.remote.state import Phase

FIGURES = Path(__file__).parents[2] / "docs" / "figures" / "gui"

pytestmark = [pytest.mark.screenshots, pytest.mark.timeout(1800)]


def save_image(operator: Operator, name: str, part: QWidget | None = None) -> None:
    """Save an image of the window, or of a part of it, with 256 colours, for small files."""
    for note in tuple(operator.window.notifications.notifications):
        note.close_button.click()
    operator.settle(1.0)
    FIGURES.mkdir(exist_ok=True)
    path = FIGURES / f"{name}.png"
    assert (part or operator.window).grab().save(str(path))
    with Image.open(path) as image:
        few = image.convert("RGB").quantize(256)
    few.save(path, optimize=True)


def save_camera_dialog(operator: Operator) -> None:
    """Another exposure of the sensor's camera, checked but not applied."""
    dialog, camera = operator.window.camera_dialogs["wfs"], operator.window.panels["camera"]
    operator.press(camera.settings_button)
    operator.until(lambda: dialog._current is not None, "the settings are shown")
    field = dialog.fields["exposure_s"]
    field.setFocus()
    field.selectAll()
    QTest.keyClicks(field, "1.5")
    operator.press(dialog.check_button)
    operator.until(dialog.apply_button.isEnabled, dialog.message.text())
    save_image(operator, "camera", dialog)
    dialog.reject()


def save_poke(operator: Operator) -> None:
    """A poke of an actuator while it is held."""
    mirror, source = operator.window.panels["mirror"], operator.window.context.session
    operator.press(mirror.arm_button)
    operator.settle(0.5)
    rows, columns = mirror._map.numbers.shape
    click_pixel(mirror.image_view, columns // 3, rows // 3)
    mirror.poke_seconds.setValue(10.0)
    mirror._on_poke_edit()
    operator.until(mirror.poke_button.isEnabled, "it can be poked")
    QTest.mousePress(mirror.poke_button, Qt.MouseButton.LeftButton)
    operator.settle(1.5)
    QTest.mouseRelease(mirror.poke_button, Qt.MouseButton.LeftButton)
    operator.until(lambda: source.source.state.mirror.peak > 0.01, "it is poked")
    save_image(operator, "poke", operator.window.docks["mirror"])
    operator.until(lambda: source.source.state.active_run is None, "it ends")
    operator.press(mirror.arm_button)


def test_images_of_the_tutorial(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serving, "SYSTEM", "razor-shwfs")
    with operating("razor-shwfs", tmp_path) as operator:
        window = operator.window
        panels, source = window.panels, window.context.session
        operator.take_control()
        operator.run("sensor")
        window.show_workspace("align")
        operator.settle(3.0)
        save_image(operator, "align")
        save_camera_dialog(operator)
        save_poke(operator)

        window.show_workspace("calibrate")
        operator.choose("escape", frames="2000")
        save_image(operator, "plan")
        before = source.source.state.last_run.id
        operator.press(operator.procedure.start)
        operator.until(lambda: panels["modes"].matrix_selector.currentData() == "live", "maps fill in")
        save_image(operator, "measuring")
        operator.until(lambda: operator.ended(before), "it ends")
        operator.run("push-pull", frames="1")
        operator.until(lambda: "push-pull" in panels["modes"].matrices, "the baseline is shown")
        panels["modes"].mosaic.choose(9)
        save_image(operator, "detail")

        operator.run("model-psf")
        window.show_workspace("operate")
        loop = panels["loop"]
        held = [one.name for one in source.source.state.products if one.name.startswith("escape")]
        made = min(held, key=len)
        operator.until(lambda: loop.matrix.findText(made) >= 0, "the matrix is offered")
        loop.matrix.setCurrentText(made)
        loop.matrix.activated.emit(loop.matrix.currentIndex())
        operator.press(loop.check_button)
        operator.until(loop.close_button.isEnabled, "the loop can be closed")
        QTest.mousePress(loop.close_button, Qt.MouseButton.LeftButton)
        operator.settle(1.5)
        QTest.mouseRelease(loop.close_button, Qt.MouseButton.LeftButton)
        operator.until(lambda: source.source.state.phase is Phase.LOOP, "the loop is closed")
        # The log names folders of this machine.
        panels["log"].search.setText("loop")
        operator.settle(30.0)
        save_image(operator, "operate")
        window.actions_by_name["open_loop"].trigger()
        operator.until(lambda: not source.source.state.loop.closed, "the loop is open")
