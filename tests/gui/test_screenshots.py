"""Creates the images of the operator's tutorial: ``pytest -m screenshots``; takes some minutes."""

from __future__ import annotations

from pathlib import Path

import pytest
import serving
from PIL import Image
from PySide6.QtCore import Qt
from PySide6.QtTest import QTest
from whole_run import Operator, operating

from escape_hw.remote.state import Phase

FIGURES = Path(__file__).parents[2] / "docs" / "figures" / "gui"

pytestmark = [pytest.mark.screenshots, pytest.mark.timeout(1800)]


def save_image(operator: Operator, name: str) -> None:
    """Save an image of the window with 256 colours, for small files."""
    for note in tuple(operator.window.notifications.notifications):
        note.close_button.click()
    operator.settle(1.0)
    FIGURES.mkdir(exist_ok=True)
    path = FIGURES / f"{name}.png"
    assert operator.window.grab().save(str(path))
    with Image.open(path) as image:
        few = image.convert("RGB").quantize(256)
    few.save(path, optimize=True)


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
