"""Display of images: stretch, colours, average, cross-sections, width of the PSF; with clicks and keys."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from gui_windows import click_pixel
from PySide6.QtCore import QPoint, Qt
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QApplication
from pytestqt.qtbot import QtBot
from scripted import ScriptedSource

from escape_gui.main_window import MainWindow
from escape_gui.panels.camera import CameraPanel
from escape_gui.panels.psf import PsfPanel, format_shape, format_widths
from escape_gui.views.images import FrameAverage
from escape_gui.widgets.images import ImageToolbar
from escape_hw.pipeline.psf.shape import PsfShape

MakeWindow = Callable[..., MainWindow]


def choose(bar: ImageToolbar, kind: str, value: object, qtbot: QtBot) -> None:
    """Open the menu and click an entry."""
    action = bar.choices[kind, value]
    bar.menu.popup(bar.mapToGlobal(QPoint(0, 0)))
    place = bar.menu.actionGeometry(action).center()
    qtbot.mouseClick(bar.menu, Qt.MouseButton.LeftButton, pos=place)
    bar.menu.close()


def test_stretches_and_colours_are_chosen_in_the_menu_and_with_keys(
    make_window: MakeWindow, qtbot: QtBot
) -> None:
    camera = make_window((CameraPanel,)).panels["camera"]
    assert isinstance(camera, CameraPanel)
    view, bar = camera.image_view, camera.bars[0]
    frame = np.arange(1600, dtype=np.uint16).reshape(40, 40)
    view.show_array(frame)
    assert bar.display_button.text() == "percentile"
    assert view.levels == pytest.approx(np.percentile(frame, (1, 99.7)))
    choose(bar, "stretch", "linear", qtbot)
    assert bar.display_button.text() == "linear"
    assert view.levels == (0, 1599)
    choose(bar, "stretch", "square root", qtbot)
    assert view.levels[1] == pytest.approx(np.sqrt(1599 - np.percentile(frame, 1)), rel=1e-3)
    view.setFocus()
    QTest.keyClick(view, Qt.Key.Key_L)
    assert bar.display_button.text() == "log"
    assert view.levels == pytest.approx((np.log10(16), np.log10(1599)), abs=0.01)
    assert bar.choices["stretch", "log"].isChecked()
    choose(bar, "colour map", 2, qtbot)
    assert view.colour_map == 2
    QTest.keyClick(view, Qt.Key.Key_M)
    assert bar.choices["colour map", 3].isChecked()


def test_frames_are_averaged(make_window: MakeWindow, source: ScriptedSource, qtbot: QtBot) -> None:
    window = make_window((CameraPanel,))
    camera = window.panels["camera"]
    assert isinstance(camera, CameraPanel)
    choose(camera.bars[0], "average", 16, qtbot)
    rng = np.random.default_rng(0)
    for _ in range(40):
        source.push("frames", rng.poisson(100, (30, 30)).astype(np.uint16), full_scale=1023.0)
        window.update_timer.tick(force=True)
    assert camera.image_view.data is not None
    assert 1 < camera.image_view.data.std() < 3.5, "the noise of 16 frames is a quarter of 10 counts"
    assert camera.bars[0].display_button.text() == "percentile, mean of 16"


def test_the_average_starts_again_with_another_shape() -> None:
    average = FrameAverage()
    average.frames = 4
    average(np.full((3, 3), 10.0))
    assert average(np.full((3, 3), 20.0)) == pytest.approx(15.0)
    assert average(np.full((2, 2), 7.0)) == pytest.approx(7.0)
    average.frames = 1
    assert average(np.full((2, 2), 9, np.uint16)).dtype == np.uint16


def test_a_click_puts_the_cross_section_and_a_double_click_takes_it_back(
    make_window: MakeWindow, source: ScriptedSource, qtbot: QtBot
) -> None:
    frame = np.add.outer(10 * np.arange(40), np.arange(40)).astype(np.uint16)
    source.push("frames", frame, full_scale=1023.0)
    camera = make_window((CameraPanel,)).panels["camera"]
    assert isinstance(camera, CameraPanel)
    qtbot.mouseClick(camera.plot_choice.buttons["section"], Qt.MouseButton.LeftButton)
    row, column = camera.section._row, camera.section._column
    assert camera.section.isVisible()
    assert row.yData.tolist() == frame[39].tolist(), "at first through the brightest pixel"
    click_pixel(camera.image_view, 5, 12)
    assert row.yData.tolist() == frame[12].tolist()
    assert column.yData.tolist() == frame[:, 5].tolist()
    assert all(line.isVisible() for line in camera.image_view._section_lines)
    click_pixel(camera.image_view, 5, 12, twice=True)
    assert row.yData.tolist() == frame[39].tolist()
    qtbot.mouseClick(camera.plot_choice.buttons["histogram"], Qt.MouseButton.LeftButton)
    assert not any(line.isVisible() for line in camera.image_view._section_lines)


def test_width_and_encircled_energy_of_the_psf(
    make_window: MakeWindow, source: ScriptedSource, qtbot: QtBot
) -> None:
    y, x = np.indices((64, 64)) - 31.5
    sigma = 2.0
    image = 20 + 800 * np.exp(-(x**2 + y**2) / (2 * sigma**2))
    source.push("psf", image.astype(np.uint16), full_scale=1023.0)
    psf = make_window((PsfPanel,)).panels["psf"]
    assert isinstance(psf, PsfPanel)
    fwhm = 2.3548 * sigma
    assert psf.shape is not None
    assert psf.shape.fwhm == pytest.approx(fwhm, rel=0.01)
    # All numbers where there is room for them.
    for width, energy in ((900, "80 % within"), (300, "80 % 3.")):
        psf.setFixedWidth(width)
        QApplication.processEvents()
        assert f"FWHM {psf.shape.fwhm:.2f} px" in psf.shape_text.text()
        assert energy in psf.shape_text.text()
        assert f"FWHM {psf.shape.fwhm:.2f} px ({psf.shape.fwhm / 2.46:.2f} λ/D)" in psf.shape_text.toolTip()
    qtbot.mouseClick(psf.choice.buttons["energy"], Qt.MouseButton.LeftButton)
    radius, share = psf._energy_curves["psf"].getData()
    assert np.interp(sigma * np.sqrt(2 * np.log(2)), radius, share) == pytest.approx(0.5, abs=0.03)
    qtbot.mouseClick(psf.choice.buttons["section"], Qt.MouseButton.LeftButton)
    assert psf.section._row.yData.max() == image.astype(np.uint16).max()


def test_an_image_without_light_has_no_width(make_window: MakeWindow, source: ScriptedSource) -> None:
    noise = np.random.default_rng(4).normal(50, 3, (64, 64))
    source.push("psf", noise.astype(np.float32))
    psf = make_window((PsfPanel,)).panels["psf"]
    assert isinstance(psf, PsfPanel)
    assert psf.shape is None
    assert "no light" in psf.shape_text.text()


def test_a_radius_beyond_the_image_is_unknown() -> None:
    shape = PsfShape(5.0, 5.0, 100.0, 900.0, 2.3, 2.5, 2.1, 0.0, 4.0, float("nan"))
    assert format_widths(shape) == "FWHM 2.30 px, 50 % 4.0 px, 80 % – px"
    assert format_shape(shape, 2.0).endswith("50 % within 4.00 px (2.00 λ/D)   80 % within – px")
