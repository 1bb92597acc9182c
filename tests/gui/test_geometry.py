"""The window from 1024 pixels: safety buttons, last line, titles and newest values are visible."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import fake_results as fake
import numpy as np
import pytest
from gui_windows import dispose, show_window
from PySide6.QtCore import QPoint, QRect, Qt
from PySide6.QtWidgets import QApplication, QScrollArea, QTabBar, QWidget
from pytestqt.qtbot import QtBot
from scripted import ScriptedSource

from escape_gui.client.session import Session
from escape_gui.main_window import MainWindow
from escape_gui.settings import Settings
from escape_gui.window.docks import WORKSPACES, visible_sizes
from escape_hw.api.registration import TO_STREAM_UNITS
from escape_hw.io.documents import calibration_document
from escape_hw.io.fits.matrix import save_matrix
from escape_hw.io.night_log import NightEntry
from escape_hw.io.provenance import format_utc
from escape_hw.remote.state import (
    Finish,
    FinishedRun,
    LoopState,
    Phase,
    ProcedureEntry,
    ProcedureParameter,
    ProductEntry,
)

Show = Callable[[Settings], MainWindow]
RESULT = fake.calibration("escape", n=8, n_modes=6)
MATRIX = fake.matrix("docrime-whitened", n=24, n_modes=30)
ESCAPE = ProcedureEntry(
    name="escape", title="ESCAPE", help="Measure, fit, compute.",
    parameters=(
        ProcedureParameter(name="accuracy", kind="float", unit="% of a sub-aperture", label="Accuracy goal"),
        ProcedureParameter(name="pokes", kind="choice", default="white", choices=("white", "anticorrelated")),
        ProcedureParameter(name="whiten", kind="bool", default=True, label="Whiten turbulence"),
        ProcedureParameter(name="closed_loop", kind="matrix"),
    ),
)  # fmt: skip


@pytest.fixture
def show(session: Session, tmp_path):
    shown: list[MainWindow] = []

    def show_with(settings: Settings) -> MainWindow:
        shown.append(show_window(session, tmp_path / "gui.json", settings=settings))
        return shown[-1]

    yield show_with
    for window in shown:
        dispose(window)


def assert_is_inside(widget: QWidget, window: MainWindow) -> None:
    assert widget.isVisible()
    place = QRect(widget.mapTo(window, QPoint(0, 0)), widget.size())
    assert window.rect().contains(place), f"{place} is not inside {window.rect()}"


def check(window: MainWindow, width: int, height: int) -> None:
    for one in WORKSPACES:
        window.show_workspace(one.name)
        window.update_timer.tick(force=True)
        for _ in range(3):
            QApplication.processEvents()
        assert (window.width(), window.height()) == (width, height), one.name
        for button in (window.header.open_button, window.header.flatten_button, window.statusBar()):
            assert_is_inside(button, window)


@pytest.mark.parametrize(
    ("size", "scale"),
    [
        ((1024, 700), 1.2),
        ((2560, 1400), 1.0),
        *(
            pytest.param(size, scale, marks=pytest.mark.slow)
            for size, scale in (
                ((1024, 700), 1.0),
                ((1280, 760), 1.0),
                ((1280, 760), 1.2),
                ((2560, 1400), 1.2),
            )
        ),
    ],
)
def test_safety_buttons_and_messages_are_visible(size: tuple[int, int], scale: float, show: Show) -> None:
    window = show(Settings(font_scale=scale))
    window.resize(*size)
    check(window, *size)


def test_the_layout_of_a_wide_screen_fits_a_narrow_one(show: Show) -> None:
    wide = show(Settings())
    wide.resize(2560, 1400)
    for one in WORKSPACES:
        wide.show_workspace(one.name)
        QApplication.processEvents()
    wide.close_without_question()
    window = show(wide._settings)
    window.resize(2560, 1400)
    window.fit_to_screen(QRect(0, 0, 1024, 768))
    QApplication.processEvents()
    assert QRect(0, 0, 1024, 768).contains(window.geometry())
    check(window, 1016, 736)


def in_front(window: MainWindow) -> set[str]:
    return {name for name, dock in window.docks.items() if not dock.visibleRegion().isEmpty()}


@pytest.mark.parametrize(
    ("workspace", "more"),
    [("align", set()), ("calibrate", {"log", "camera", "gains"}), ("operate", {"log", "mirror", "trends"})],
)
@pytest.mark.slow
def test_a_large_window_shows_more_panels_at_once(workspace: str, more: set[str], show: Show) -> None:
    window = show(Settings(workspace=workspace))
    window.resize(1280, 760)
    QApplication.processEvents()
    before = in_front(window)
    window.resize(2560, 1400)
    for _ in range(5):
        QApplication.processEvents()
    assert (window.width(), window.height()) == (2560, 1400)
    assert in_front(window) == before | more
    window.resize(1280, 760)
    for _ in range(5):
        QApplication.processEvents()
    assert in_front(window) == before
    assert (window.width(), window.height()) == (1280, 760)


@pytest.mark.slow
def test_layouts_of_large_and_small_windows_are_kept_apart(show: Show, tmp_path) -> None:
    window = show(Settings(workspace="operate"))
    window.resize(2560, 1400)
    for _ in range(5):
        QApplication.processEvents()
    widths = [window.docks[name].width() for name in ("loop", "performance", "camera")]
    window.docks["mirror"].hide()
    window.refresh()
    for size in ((1280, 760), (2560, 1400)):
        window.resize(*size)
        for _ in range(5):
            QApplication.processEvents()
    assert not window.docks["mirror"].isVisible()
    window.actions_by_name["reset_layout"].trigger()
    QApplication.processEvents()
    assert window.docks["mirror"].isVisible()
    # As at first, not as it was squeezed into the small window.
    again = [window.docks[name].width() for name in ("loop", "performance", "camera")]
    assert again == pytest.approx(widths, rel=0.1)


@pytest.mark.slow
def test_the_focus_stays_when_the_window_becomes_large_or_small(show: Show) -> None:
    window = show(Settings(workspace="operate"))
    window.resize(1280, 760)
    QApplication.processEvents()
    gain = window.panels["loop"].gain
    gain.setFocus()
    for size in ((2560, 1400), (1280, 760)):
        window.resize(*size)
        for _ in range(5):
            QApplication.processEvents()
        assert window.focusWidget() is gain, size
    # A field of a panel that the small window does not show.
    window.resize(2560, 1400)
    for _ in range(5):
        QApplication.processEvents()
    window.panels["log"].search.setFocus()
    window.resize(1280, 760)
    for _ in range(5):
        QApplication.processEvents()
    assert window.focusWidget() is window


@pytest.mark.slow
def test_a_large_window_is_arranged_anew_for_larger_fonts(show: Show) -> None:
    window = show(Settings(workspace="operate"))
    window.resize(2560, 1400)
    for _ in range(5):
        QApplication.processEvents()
    assert "trends" in in_front(window)
    for _ in range(5):
        window.actions_by_name["larger"].trigger()
    for _ in range(5):
        QApplication.processEvents()
    assert "trends" not in in_front(window)
    assert (window.width(), window.height()) == (2560, 1400)
    # What the operator changes from now on is remembered.
    window.docks["mirror"].hide()
    window.refresh()
    window.show_workspace("align")
    window.show_workspace("operate")
    assert not window.docks["mirror"].isVisible()


@pytest.mark.parametrize("workspace", [one.name for one in WORKSPACES])
@pytest.mark.slow
def test_a_layout_is_the_same_after_the_window_had_another_size(workspace: str, show: Show) -> None:
    window = show(Settings(workspace=workspace))

    def resize(width: int, height: int) -> None:
        window.resize(width, height)
        for _ in range(5):
            QApplication.processEvents()
        window.refresh()
        assert (window.width(), window.height()) == (width, height)

    for one, other in (((2560, 1400), (1024, 700)), ((1024, 700), (2560, 1400)), ((1600, 960), (2560, 1400))):
        resize(*one)
        window.reset_layout()
        resize(*one)
        before = visible_sizes(window.docks.values())
        resize(*other)
        resize(*one)
        for dock in visible_sizes(window.docks.values()):
            assert dock.width() == pytest.approx(before[dock].width(), rel=0.1), (one, dock.windowTitle())
            assert dock.height() == pytest.approx(before[dock].height(), rel=0.1), (one, dock.windowTitle())


@pytest.mark.parametrize("workspace", [one.name for one in WORKSPACES])
@pytest.mark.slow
def test_a_layout_is_scaled_to_a_window_that_was_large_meanwhile(workspace: str, show: Show) -> None:
    window = show(Settings(workspace=workspace))
    sizes = []
    for size in ((1600, 960), (2560, 1400), (1200, 720)):
        window.resize(*size)
        for _ in range(5):
            QApplication.processEvents()
        window.refresh()
        sizes.append(visible_sizes(window.docks.values()))
    for dock, size in sizes[2].items():
        assert size.width() == pytest.approx(0.75 * sizes[0][dock].width(), rel=0.15), dock.windowTitle()
        assert size.height() == pytest.approx(0.72 * sizes[0][dock].height(), rel=0.15), dock.windowTitle()


def wide_panels(window: MainWindow) -> set[str]:
    """Visible panels that do not fit the width of their dock."""
    areas = {name: dock.widget() for name, dock in window.docks.items() if not dock.visibleRegion().isEmpty()}
    return {
        name
        for name, area in areas.items()
        if isinstance(area, QScrollArea) and area.horizontalScrollBar().maximum() > 0
    }


@pytest.mark.parametrize(
    "workspace",
    [pytest.param(one.name, marks=pytest.mark.slow if one.name == "align" else ()) for one in WORKSPACES],
)
def test_panels_and_their_tabs_fit_the_narrowest_window(
    workspace: str, show: Show, source: ScriptedSource
) -> None:
    source.entries = (ESCAPE,)
    now = format_utc(datetime.now(UTC))
    source.night = [NightEntry(number=0, at_utc=now, kind="sample", values={"strehl": 40.0})]
    window = show(Settings(workspace=workspace))
    window.resize(1024, 700)
    # With a registration, and without a Strehl ratio.
    path = np.array([step.registration.to_array() for step in fake.registration().iterations])
    source.push("valid", MATRIX.valid.astype(np.float32))
    source.push("matrix", MATRIX.data, method="docrime")
    source.push("registration", (path * TO_STREAM_UNITS).astype(np.float32))
    ended = FinishedRun(id=3, name="escape", finish=Finish.DONE, document=calibration_document(RESULT))
    loop = source.state.loop.model_copy(update={"strehl": None})
    source.change(last_run=ended, loop=loop)
    for _ in range(5):
        window.update_timer.tick(force=True)
        QApplication.processEvents()
    assert wide_panels(window) == set()
    for dock in window.docks.values():
        # Panels behind others, too.
        if dock.isVisible():
            dock.raise_()
            for _ in range(3):
                window.update_timer.tick(force=True)
                QApplication.processEvents()
            assert wide_panels(window) == set(), dock.windowTitle()
    form = window.panels["procedure"].form
    assert form._area.horizontalScrollBar().maximum() == 0
    for bar in window.findChildren(QTabBar, options=Qt.FindChildOption.FindDirectChildrenOnly):
        if bar.isVisible() and bar.count():
            assert bar.elideMode() is Qt.TextElideMode.ElideNone
            last = bar.tabRect(bar.count() - 1)
            assert bar.rect().contains(last), [bar.tabText(k) for k in range(bar.count())]


def assert_is_in_its_dock(widget: QWidget, window: MainWindow, panel: str) -> None:
    """The whole widget is visible without scrolling."""
    area = window.docks[panel].widget()
    assert isinstance(area, QScrollArea)
    place = QRect(widget.mapTo(area.viewport(), QPoint(0, 0)), widget.size())
    assert widget.isVisible()
    assert area.viewport().rect().contains(place), f"{place} is not inside {area.viewport().rect()}"


@pytest.mark.parametrize(
    ("workspace", "panel", "button"),
    [("operate", "loop", "close_button"), ("align", "mirror", "poke_button")],
)
def test_buttons_that_are_held_are_visible_in_the_narrowest_window(
    workspace: str, panel: str, button: str, show: Show, source: ScriptedSource, qtbot: QtBot
) -> None:
    source.change(phase=Phase.IDLE, loop=LoopState(matrix="escape", gain=0.425, leak=0.026), active_run=None)
    window = show(Settings(workspace=workspace))
    window.resize(1024, 700)
    found = window.panels[panel]
    if panel == "mirror":
        found.arm_button.click()
        qtbot.waitUntil(lambda: "nm of surface" in found.poke_text.text())
    for _ in range(5):
        window.update_timer.tick(force=True)
        QApplication.processEvents()
    if panel == "mirror":
        # The longest text, as while it is held.
        found._show_poke(f"Held: {found._plan.description}")
        QApplication.processEvents()
        assert found.poke_text.height() >= found.poke_text.heightForWidth(found.poke_text.width())
        assert found.image_view.geometry().bottom() < found.arm_button.geometry().top()
    assert_is_in_its_dock(getattr(window.panels[panel], button), window, panel)


@pytest.mark.slow
def test_long_names_of_matrices_fit_the_narrowest_window(
    show: Show, source: ScriptedSource, tmp_path: Path, qtbot: QtBot
) -> None:
    names = ("docrime-2026-11-22 214530-17", "escape-2026-11-22 214530-2", "escape-2026-11-22 214530-3")
    products = []
    for k, name in enumerate(names):
        result = fake.calibration(name.split("-", maxsplit=1)[0], n=8, n_modes=6 + k)
        path = save_matrix(tmp_path / f"{name}.fits", result, fake.ORIGIN)
        products.append(ProductEntry(name=name, kind="matrix", path=str(path)))
    loop = source.state.loop.model_copy(update={"matrix": names[-1]})
    source.change(products=tuple(products), loop=loop)
    source.entries = (ESCAPE,)
    window = show(Settings(workspace="calibrate"))
    window.resize(1024, 700)
    modes, panel = window.panels["modes"], window.panels["loop"]

    def listed() -> bool:
        window.update_timer.tick(force=True)
        return modes.matrix_selector.count() > 2

    qtbot.waitUntil(listed, timeout=30_000)
    selector = modes.matrix_selector
    for k in range(selector.count()):
        selector.setCurrentIndex(k)
        QApplication.processEvents()
        for widget in (selector, modes.weight_by_snr):
            assert_is_in_its_dock(widget, window, "modes")
        # The first and the last letters distinguish them.
        assert selector.shown_text[0] == selector.currentText()[0]
        assert selector.shown_text[-1] == selector.currentText()[-1]
    modes.mosaic.choose(2)
    window.update_timer.tick(force=True)
    QApplication.processEvents()
    tiles = [one for one in modes.detail._tile_widgets if one[0].isVisible()]
    assert len(tiles) > len(names)
    for _, lines, image in tiles:
        for line in lines:
            assert_is_in_its_dock(line, window, "modes")
            assert line.height() >= line.fontMetrics().height()
            assert not line.geometry().intersects(image.geometry())
        assert image.height() >= image.minimumHeight()
        assert lines[0].text()[-1] == lines[0].whole_text[-1], "elided in the middle"
    short = ("push-pull", "ESCAPE (escape-17)")
    for text in short:
        selector.setItemText(selector.currentIndex(), text)
        QApplication.processEvents()
        assert selector.shown_text == text
    window.show_workspace("operate")
    for _ in range(3):
        window.update_timer.tick(force=True)
        QApplication.processEvents()
    assert wide_panels(window) == set()
    assert panel.matrix.shown_text.endswith("-3")
    assert panel.current_matrix.text().endswith("-3")
    assert panel.current_matrix.toolTip() == names[-1]
    assert_is_in_its_dock(panel.gain, window, "loop")
