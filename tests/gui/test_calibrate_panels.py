"""The panels of the Calibrate workspace on a scripted source."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations
from pathlib import Path

import fake_results as fake
import numpy as np
import pytest
from gui_windows import dispose, enter_argument, refresh, show_window, until
from pyqtgraph import AxisItem
from PySide6.QtCore import QPoint, QRectF, Qt
from PySide6.QtGui import QImage, QPainter
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QApplication, QPushButton
from scripted import ScriptedControl, ScriptedSource, running

from escape_gui.client.session import Session
from escape_gui.main_window import MainWindow
from escape_gui.panels.base import Panel
from escape_gui.panels.gains import GainsPanel
from escape_gui.panels.modes import LIVE_LABEL, ModesPanel
from escape_gui.panels.procedure import ProcedurePanel
from escape_gui.panels.sprint import SprintPanel
from escape_gui.settings import Settings
from escape_gui.widgets.controls import Level
from escape_gui.widgets.mode_maps import best_columns
from escape_hw.api.registration import TO_STREAM_UNITS
from escape_hw.calibration.sprint.goodness_of_fit import NOT_JUDGED
from escape_hw.io.documents import calibration_document
from escape_hw.io.fits.gains import save_gains
from escape_hw.io.fits.matrix import save_matrix
from escape_hw.remote.state import (
    ActiveRun,
    Finish,
    FinishedRun,
    Phase,
    ProcedureEntry,
    ProcedureParameter,
    ProductEntry,
)

PROCEDURES = (
    ProcedureEntry(
        name="escape",
        title="ESCAPE",
        help="Calibrates without a source.",
        parameters=(
            ProcedureParameter(
                name="frames", kind="int", default=1000, unit="frame", low=1, high=1e6, help="How many."
            ),
            ProcedureParameter(name="snr", kind="float", low=0.01, help="Goal."),
            ProcedureParameter(
                name="pokes", kind="choice", default="white", choices=("white", "anticorrelated")
            ),
            ProcedureParameter(name="plain", kind="bool", default=False),
            ProcedureParameter(name="closed_loop", kind="matrix"),
        ),
    ),
    ProcedureEntry(
        name="gains",
        title="Optical gains",
        help="Scale it.",
        parameters=(ProcedureParameter(name="im", kind="matrix"),),
    ),
)
MATRIX = fake.calibration("docrime-whitened", n=24, n_modes=30).matrix
RUNNING = ActiveRun(
    id=3, name="escape", arguments={}, stage="DO-CRIME", completed=610, total=1000, remaining_s=252.0
)


def labels(axis: AxisItem) -> list[QRectF]:
    """Rectangles of the numbers of an axis, as they are drawn."""
    image = QImage(8, 8, QImage.Format.Format_ARGB32)
    painter = QPainter(image)
    _, _, texts = axis.generateDrawSpecs(painter)
    painter.end()
    return [place for place, _, text in texts if text]


@pytest.fixture
def source() -> ScriptedSource:
    source = ScriptedSource()
    source.entries = PROCEDURES
    source.change(phase=Phase.IDLE, products=())
    return source


def shown(session: Session, path: Path, *kinds: type[Panel]) -> MainWindow:
    window = show_window(session, path, kinds, Settings(workspace="calibrate"))
    window.resize(1600, 1000)
    for dock in window.docks.values():
        dock.show()
    QApplication.processEvents()
    return window


@pytest.fixture
def calibrate(session: Session, tmp_path: Path) -> Iterator[MainWindow]:
    window = shown(session, tmp_path / "gui.json", ProcedurePanel, ModesPanel, SprintPanel, GainsPanel)
    yield window
    dispose(window)


@pytest.fixture
def form(session: Session, tmp_path: Path) -> Iterator[MainWindow]:
    """A window with the form alone."""
    window = shown(session, tmp_path / "gui.json", ProcedurePanel)
    yield window
    dispose(window)


def press(button: QPushButton) -> None:
    QTest.mouseClick(button, Qt.MouseButton.LeftButton)


def measure(source: ScriptedSource, share: float) -> None:
    """Push the matrix with the standard errors after a fraction of its frames."""
    sigma = MATRIX.sigma / np.sqrt(share)
    source.push("valid", MATRIX.valid.astype(np.float32))
    source.push("matrix_sigma", sigma, stage="DO-CRIME")
    source.push("matrix", MATRIX.data, stage="DO-CRIME")


# ---------------------------------------------------------------- mode maps
def test_mode_maps_fill_in_while_they_are_measured(calibrate, source):
    panel = calibrate.panels["modes"]
    refresh(calibrate)
    assert panel.shows_placeholder
    source.change(phase=Phase.PROCEDURE, active_run=RUNNING)
    measure(source, 1e-4)
    refresh(calibrate)
    assert not panel.shows_placeholder
    assert panel.matrix_selector.currentData() == LIVE_LABEL
    assert panel.matrix_selector.currentText() == "DO-CRIME, live"
    pale = contrast(panel)
    measure(source, 1.0)
    refresh(calibrate)
    assert contrast(panel) > 2 * pale
    panel.weight_by_snr.setChecked(False)
    assert contrast(panel) > 2 * pale
    # Aborted without a product.
    source.change(phase=Phase.IDLE, active_run=None)
    refresh(calibrate)
    assert panel.matrix_selector.currentText() == "DO-CRIME, as measured"


def test_live_maps_belong_to_the_run_that_measures(calibrate, source):
    panel = calibrate.panels["modes"]
    source.change(phase=Phase.PROCEDURE, active_run=RUNNING)
    measure(source, 1.0)
    refresh(calibrate)
    assert panel.matrix_selector.currentData() == LIVE_LABEL
    # The next run has measured nothing yet.
    source.change(active_run=RUNNING.model_copy(update={"id": 4, "completed": 0}))
    refresh(calibrate)
    assert LIVE_LABEL not in panel.matrices


def test_controls_of_the_maps_follow_what_is_visible_and_not_what_they_widen(
    calibrate: MainWindow, source: ScriptedSource, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Otherwise the area around, which gives the panel the width that its controls need, never ends.
    measure(source, 1.0)
    refresh(calibrate)
    panel, area = calibrate.panels["modes"], calibrate.docks["modes"].widget()
    assert isinstance(panel, ModesPanel)

    def in_one_line() -> bool:
        return panel._controls.itemAtPosition(0, 1) is not None

    area.setParent(None)
    area.resize(331, 640)
    area.show()
    QApplication.processEvents()
    assert not in_one_line()
    # A name shorter than the selector can become, and several pages: nothing is wider than what is visible.
    for button in panel._page_controls:
        button.show()
    for width in range(250, 500, 10):
        panel.matrix_selector.setItemText(panel.matrix_selector.currentIndex(), "r")
        area.resize(width, 640)
        QApplication.processEvents()
        assert not in_one_line() or panel.width() <= width
    area.resize(331, 640)
    QApplication.processEvents()
    with monkeypatch.context() as wide:
        wide.setattr(panel, "width", lambda: 800)
        panel._arrange_controls()
    assert not in_one_line()
    area.resize(800, 640)
    QApplication.processEvents()
    assert in_one_line()
    area.setParent(calibrate)


def contrast(panel: ModesPanel) -> float:
    """Mean distance of the mosaic's colours from white."""
    picture = panel.mosaic._image.image.astype(float)
    return float(np.abs(picture[picture > 0] - 128).mean())


def test_a_click_shows_the_mode_in_every_matrix(calibrate, source, tmp_path):
    panel = calibrate.panels["modes"]
    products = []
    for method in ("push-pull", "escape"):
        made = fake.calibration(method, n=24, n_modes=30)
        path = save_matrix(tmp_path / f"{method}.fits", made, fake.ORIGIN)
        products.append(ProductEntry(name=method, kind="matrix", path=str(path)))
    source.change(products=tuple(products))
    until(lambda: "ESCAPE" in panel.matrices, calibrate)
    refresh(calibrate)
    mosaic = panel.mosaic
    top, left = mosaic._layout.corner(4)
    place = mosaic._box.mapViewToScene(mosaic._box.mapToView(mosaic._box.rect().center()))
    middle = mosaic._box.mapViewToScene(QPoint(left + 12, top + 12))
    assert place is not None
    QTest.mouseMove(mosaic._view.viewport(), middle.toPoint())
    QTest.mouseClick(mosaic._view.viewport(), Qt.MouseButton.LeftButton, pos=middle.toPoint())
    until(lambda: mosaic.mode == 4, calibrate)
    assert panel.detail.isVisible()
    assert tuple(one.title for one in panel.detail.tiles) == (
        "push-pull", "DO-CRIME", "ESCAPE", "ESCAPE − push-pull", "Error of DO-CRIME",
        "SNR of DO-CRIME",
    )  # fmt: skip
    assert panel._status_label.text().startswith("mode 5  rms slope")
    mosaic.setFocus()
    QTest.keyClick(mosaic, Qt.Key.Key_Right)
    assert mosaic.mode == 5
    QTest.keyClick(mosaic, Qt.Key.Key_Escape)
    assert not panel.detail.isVisible()
    names = [array.name for array in panel.export_arrays()]
    assert names == ["matrix", "sigma"]


def test_matrices_and_gains_are_listed_again_after_a_crash_of_the_engine(calibrate, source, tmp_path):
    modes, gains = calibrate.panels["modes"], calibrate.panels["gains"]
    products = []
    for method in ("push-pull", "escape"):
        made = fake.calibration(method, n=24, n_modes=30)
        path = save_matrix(tmp_path / f"{method}.fits", made, fake.ORIGIN)
        products.append(ProductEntry(name=method, kind="matrix", path=str(path)))
    path = save_gains(tmp_path / "gains.fits", fake.gains_result(), "razor-shwfs", True, fake.ORIGIN)
    products.append(ProductEntry(name="gains", kind="gains", path=str(path)))
    source.change(products=tuple(products))
    until(lambda: {"push-pull", "ESCAPE"} <= set(modes.matrices), calibrate)
    until(lambda: bool(gains._curves), calibrate)
    names, curves = list(modes.matrices), list(gains._curves)
    modes.matrix_selector.setFocus()
    QTest.keyClick(modes.matrix_selector, Qt.Key.Key_Home)
    modes.matrix_selector.activated.emit(0)
    source.fail("the engine died")
    source.change(engine_pid=0)
    refresh(calibrate)
    source.change(engine_pid=12, phase=Phase.STARTING, fault=None)
    refresh(calibrate)
    assert [modes.matrix_selector.itemData(k) for k in range(modes.matrix_selector.count())] == names
    assert modes.matrix_selector.currentData() == names[0]
    assert not modes.shows_placeholder
    assert list(gains._curves) == curves
    assert not gains.shows_placeholder


@pytest.mark.parametrize(
    ("width", "height", "columns"), [(900, 260, 6), (480, 300, 3), (500, 700, 2), (500, 1200, 1)]
)
def test_tiles_use_the_available_space(width, height, columns):
    assert best_columns(6, width, height, 56) == columns


def test_pages_change(calibrate, source):
    panel = calibrate.panels["modes"]
    source.change(phase=Phase.PROCEDURE, active_run=RUNNING)
    measure(source, 1.0)
    refresh(calibrate)
    panel.mosaic.setMaximumSize(240, 160)
    refresh(calibrate)
    page, pages = panel.mosaic.page
    assert (page, pages > 1) == (0, True)
    press(panel._next_button)
    assert panel.mosaic.page[0] == 1
    assert panel._page_label.text() == f"2 of {pages}"
    panel.mosaic.choose(29)
    assert panel.mosaic.page[0] == pages - 1
    assert not panel._next_button.isEnabled()


def test_a_short_result_after_a_long_one_has_no_gaps(calibrate: MainWindow, source: ScriptedSource) -> None:
    panel = calibrate.panels["procedure"]
    documents = (calibration_document(fake.calibration("escape", n=8, n_modes=6)), {"n_sub_apertures": 448})
    for k, document in enumerate(documents):
        source.change(last_run=FinishedRun(id=k, name=f"run {k}", finish=Finish.DONE, document=document))
        for _ in range(3):
            source.change()
            refresh(calibrate)
    assert panel.numbers.text() == "Sub-apertures: 448"
    assert panel.numbers.height() < 2 * panel.numbers.fontMetrics().lineSpacing()


# ---------------------------------------------------------------- keyboard
def test_the_tab_key_goes_through_the_form_before_the_buttons(
    form: MainWindow, control: ScriptedControl
) -> None:
    panel = form.panels["procedure"]
    until(panel.start.isEnabled, form)
    panel.choice.setCurrentIndex(1)
    panel.choice.setCurrentIndex(0)
    until(panel.start.isEnabled, form)
    form.activateWindow()
    panel.choice.setFocus()
    reached = []
    for _ in range(7):
        QTest.keyClick(QApplication.focusWidget(), Qt.Key.Key_Tab)
        widget = QApplication.focusWidget()
        text = widget.text() if isinstance(widget, QPushButton) else ""
        reached.append(widget.accessibleName() or text.replace("&", ""))
    assert reached == ["Frames", "Snr", "Pokes", "Plain", "Closed loop", "Check", "Start"]


def test_another_workspace_leaves_the_focus_to_nobody(calibrate: MainWindow) -> None:
    calibrate.activateWindow()
    calibrate.panels["procedure"].choice.setFocus()
    calibrate.show_workspace("operate")
    assert QApplication.focusWidget() is calibrate


# ---------------------------------------------------------------- SPRINT and gains
def test_sprint_shows_its_iterations_and_its_end(calibrate, source):
    panel = calibrate.panels["sprint"]
    estimate = fake.registration()
    path = np.array([step.registration.to_array() for step in estimate.iterations])
    norm = np.array([step.step_norm for step in estimate.iterations])
    source.change(phase=Phase.PROCEDURE, active_run=RUNNING)
    source.push("registration", path[:6] * TO_STREAM_UNITS)
    source.push("registration_sigma", np.full(5, np.nan))
    source.push("step_norm", norm[:6])
    refresh(calibrate)
    assert panel._indicator.text == "running, 6 iterations"
    source.push("registration", path * TO_STREAM_UNITS)
    source.push("registration_sigma", estimate.sigma * TO_STREAM_UNITS)
    source.push("step_norm", norm)
    document = calibration_document(fake.calibration("escape"))
    ended = FinishedRun(id=3, name="escape", finish=Finish.DONE, document=document)
    source.change(phase=Phase.IDLE, active_run=None, last_run=ended)
    refresh(calibrate)
    assert panel._indicator.text == "converged, 18 iterations"
    assert "±" in panel._values[0].text()
    assert "tangential_scaling is consistent with zero" in panel._notes.label.text()
    # Runs without a registration do not change the state of the fit.
    for k, name, told in ((4, "push-pull", None), (5, "gains", False)):
        ended = FinishedRun(id=k, name=name, finish=Finish.ABORTED, document={"converged": told})
        source.change(last_run=ended)
        refresh(calibrate)
        assert panel._indicator.text == "converged, 18 iterations"
    for size in ((1600, 1000), (1280, 760)):
        calibrate.resize(*size)
        refresh(calibrate)
        places = labels(panel.plot._plots[0].getAxis("left"))
        assert places, size
        assert not any(a.intersects(b) for a, b in combinations(places, 2)), f"labels overlap at {size}"
    press(panel.units)
    assert panel.plot.physical
    table = panel.export_arrays()[0].data
    np.testing.assert_allclose(table[:, 2:], path, rtol=1e-6)


def test_the_profile_of_the_influence_functions_is_shown(calibrate, source):
    panel, profile = calibrate.panels["sprint"], fake.influence_profile()
    document = calibration_document(fake.calibration("escape"))
    source.push("registration", np.zeros((1, 5)))
    source.change(last_run=FinishedRun(id=3, name="escape", finish=Finish.DONE, document=document))
    refresh(calibrate)
    panel.tabs.setCurrentWidget(panel.profile)
    nominal, fitted, edge = (band.line.getData()[1] for band in panel.profile.bands)
    np.testing.assert_allclose(nominal, profile.nominal)
    np.testing.assert_allclose(fitted, profile.fitted)
    np.testing.assert_allclose(edge, profile.edge)
    panel.clear()
    assert all(not len(band.line.xData) for band in panel.profile.bands if band.line.xData is not None)


def test_a_drift_is_shown(calibrate, source):
    panel = calibrate.panels["sprint"]
    track = np.zeros((30, 11))
    track[:, 0] = np.arange(30)
    track[:, 1] = 0.001 * np.arange(30)
    source.push("registration_track", track)
    refresh(calibrate)
    assert panel.tabs.currentIndex() == 1
    np.testing.assert_allclose(panel.export_arrays()[-1].data[-1, 1], 2.9)


def test_gains_appear_round_by_round(calibrate, source):
    panel = calibrate.panels["gains"]
    gains = fake.optical_gains(0.7)
    source.change(phase=Phase.PROCEDURE, active_run=RUNNING)
    source.push("gains", gains.value, stage="round 2")
    source.push("gains_sigma", gains.sigma)
    source.push("gains_smooth", gains.trend)
    source.push("gains_rounds", np.stack([gains.best, 1.01 * gains.best]))
    refresh(calibrate)
    assert "median 0.700" in panel._legend.text()
    assert "2 rounds" in panel._legend.text()
    assert list(panel.plot._boxes) == ["left"], "the help promises a second axis for matrices of both kinds"
    press_box(panel)
    assert panel.export_arrays()[0].data.shape == (20, 5)


def press_box(panel: GainsPanel) -> None:
    panel.rounds.click()
    assert not panel.rounds.isChecked()


# ---------------------------------------------------------------- procedures
def test_a_procedure_is_started_from_the_form(form, source, control):
    panel = form.panels["procedure"]
    refresh(form)
    assert [panel.choice.itemText(k) for k in range(panel.choice.count())] == ["ESCAPE", "Optical gains"]
    assert not panel.start.isEnabled()
    enter_argument(panel.form, "frames", "200")
    enter_argument(panel.form, "pokes", "anticorrelated")
    until(panel.start.isEnabled, form)
    arguments = {"frames": 200, "pokes": "anticorrelated"}
    assert ("plan", {"procedure": "escape", "arguments": arguments}) in control.asked
    assert "frames" in panel.plan.text()
    assert "% of stroke" in panel.plan.text()
    press(panel.start)
    until(lambda: any(verb == "start" for verb, _ in control.asked), form)
    assert ("start", {"args": ("escape",), **arguments}) in control.asked


def test_an_invalid_form_starts_nothing(form, control):
    panel = form.panels["procedure"]
    refresh(form)
    until(panel.start.isEnabled, form)
    enter_argument(panel.form, "frames", "zero")
    assert not panel.start.isEnabled()
    press(panel.check)
    assert "'zero' is no number" in panel.plan.text()
    refresh(form)
    assert not panel.start.isEnabled()
    assert "not checked" in panel.start.toolTip()


def test_a_refusal_is_shown_below_the_form(form, control):
    panel = form.panels["procedure"]
    control.refuse = "no light on the sensor"
    refresh(form)
    until(lambda: "no light" in panel.plan.text(), form)
    assert not panel.start.isEnabled()
    control.refuse = ""


def test_a_procedure_is_monitored_paused_and_aborted(form, source, control):
    panel = form.panels["procedure"]
    refresh(form)
    assert not panel.abort.isEnabled()
    assert "no procedure is running" in panel.abort.toolTip()
    measure(source, 1.0)
    source.change(phase=Phase.PROCEDURE, active_run=RUNNING)
    refresh(form)
    source.change()
    refresh(form)
    assert panel.progress.text() == "DO-CRIME: 610 of 1000 frames, 4:12 min left"
    assert "worst mode 1: SNR" in panel._metrics.text()
    assert panel.bar.value() == 610
    assert "a procedure is running" in panel.start.toolTip()
    press(panel.pause)
    until(lambda: ("pause", {}) in control.asked, form)
    source.change(active_run=RUNNING.model_copy(update={"paused": True}))
    refresh(form)
    assert panel.pause.text() == "Resume"
    press(panel.pause)
    until(lambda: ("resume", {}) in control.asked, form)
    press(panel.abort)
    until(lambda: ("abort", {}) in control.asked, form)


def test_the_result_is_compared_with_the_previous_one(form, source):
    panel = form.panels["procedure"]
    document = calibration_document(fake.calibration("escape"))
    first = FinishedRun(id=1, name="escape", finish=Finish.DONE, folder="/runs/1", document=document)
    source.change(last_run=first)
    refresh(form)
    assert panel.outcome.text() == "Done: escape"
    assert "Δ" not in panel.numbers.text()
    assert not panel.report.isVisible()
    second = first.model_copy(update={"id": 2, "products": {"report": "/runs/2/report.html"}})
    source.change(last_run=second)
    refresh(form)
    assert "(Δ 0.00 ± " in panel.numbers.text()
    assert panel.report.isVisible()


def test_the_result_outlasts_the_engine_but_not_the_bench(form, source, session, control):
    panel = form.panels["procedure"]
    document = calibration_document(fake.calibration("escape"))
    source.change(last_run=FinishedRun(id=2, name="escape", finish=Finish.DONE, document=document))
    refresh(form)
    told = panel.numbers.text()
    source.change(engine_pid=12, last_run=None)
    refresh(form)
    assert panel._result_area.isVisible()
    assert panel.numbers.text() == told
    source.change(last_run=FinishedRun(id=3, name="escape", finish=Finish.DONE, document=document))
    refresh(form)
    assert "Δ" in panel.numbers.text(), "the result of the engine before is compared"
    session.set_source(ScriptedSource(running(system="maps-nir")), control)
    refresh(form)
    assert not panel._result_area.isVisible()


def test_new_matrices_are_offered_to_the_form(form, source):
    panel = form.panels["procedure"]
    refresh(form)
    panel.choice.setCurrentIndex(1)
    box = panel.form.fields["im"]
    assert box.currentText() == "–"
    names = ("first", "second")
    source.change(products=tuple(ProductEntry(name=name, kind="matrix", path="/x.fits") for name in names))
    refresh(form)
    assert box.currentText() == "second"
    enter_argument(panel.form, "im", "first")
    source.change(
        products=(*source.state.products, ProductEntry(name="third", kind="matrix", path="/x.fits"))
    )
    refresh(form)
    assert box.currentText() == "first"


def test_the_newest_matrix_is_the_default_also_when_those_of_a_run_arrive_one_by_one(form, source):
    panel = form.panels["procedure"]
    refresh(form)
    panel.choice.setCurrentIndex(1)
    for name in ("escape-1-docrime", "escape-1"):
        entry = ProductEntry(name=name, kind="matrix", path="/x.fits")
        source.change(products=(*source.state.products, entry))
        refresh(form)
        assert panel.form.fields["im"].currentText() == name


def test_without_control_nothing_starts(session, source, control, form):
    source.change(lease=None)
    refresh(form)
    panel = form.panels["procedure"]
    assert not panel.start.isEnabled()
    assert "take control" in panel.start.toolTip()
    assert panel.check.isEnabled()
    assert isinstance(control, ScriptedControl)


def push_convergence(source):
    """The iterations of a fit that has ended."""
    estimate = fake.registration()
    path = np.array([step.registration.to_array() for step in estimate.iterations])
    source.push("registration", path * TO_STREAM_UNITS)
    source.push("registration_sigma", estimate.sigma * TO_STREAM_UNITS)
    source.push("step_norm", np.array([step.step_norm for step in estimate.iterations]))


def test_a_converged_fit_with_a_noisy_mode_or_a_misfit_is_not_green(calibrate, source):
    push_convergence(source)
    document = {**calibration_document(fake.calibration("escape")), "snr": {"min": 0.35, "median": 9.0}}
    document |= {"warnings": [], "clipped_pokes": 350, "frames": 1000}
    source.change(last_run=FinishedRun(id=3, name="escape", finish=Finish.DONE, document=document))
    refresh(calibrate)
    sprint, procedure = calibrate.panels["sprint"], calibrate.panels["procedure"]
    assert (sprint._indicator.level, sprint._indicator.text) == (Level.WARNING, "converged, 18 iterations")
    line = "Usable: SNR 0.35 in the worst mode"
    assert line in sprint._notes.label.text()
    assert line in procedure.verdict.text()
    assert "Pokes clipped: 35 % (350 of 1000)" in procedure.numbers.text()
    calibrate.refresh()
    source.change(last_run=FinishedRun(id=4, name="escape", finish=Finish.DONE, document=document))
    calibrate.refresh()
    told = calibrate.notifications.notifications[-1]
    assert told.level is Level.WARNING
    assert line in told.text
    document = {**calibration_document(fake.calibration("escape", fits=False)), "warnings": []}
    source.change(last_run=FinishedRun(id=5, name="escape", finish=Finish.DONE, document=document))
    refresh(calibrate)
    words = "converged, but the model does not fit"
    assert (sprint._indicator.level, sprint._indicator.text) == (Level.WARNING, f"{words}, 18 iterations")
    assert f"Usable: {words} (14% of the matrix" in sprint._notes.label.text()
    assert "the model does not fit: 14% of the matrix remain" in sprint._notes.label.text()
    assert f"Usable: {words}" in procedure.verdict.text()
    calibrate.refresh()
    assert f"Usable: {words}" in calibrate.notifications.notifications[-1].text


def test_a_fit_without_an_iteration_yet_is_waited_for(calibrate, source):
    """As the first progress of a short run, whose frames are fitted."""
    source.push("registration", np.zeros((0, 5), np.float32))
    source.push("step_norm", np.zeros(0, np.float32))
    refresh(calibrate)
    assert calibrate.update_timer.failed_panels == {}
    push_convergence(source)
    refresh(calibrate)
    assert calibrate.update_timer.failed_panels == {}
    assert "18 iterations" in calibrate.panels["sprint"]._indicator.text


def test_many_notes_leave_room_for_the_convergence(calibrate, source):
    push_convergence(source)
    notes = [NOT_JUDGED, *(f"note {k} that is long enough to need two lines of the panel" for k in range(12))]
    document = {
        **calibration_document(fake.calibration("escape")), "snr": {"min": None}, "model_fits": None,
        "warnings": [], "registration_notes": notes,
    }  # fmt: skip
    source.change(last_run=FinishedRun(id=3, name="escape", finish=Finish.DONE, document=document))
    refresh(calibrate)
    sprint = calibrate.panels["sprint"]
    shown = sprint._notes.label.text()
    assert shown.count("no standard errors") == 1
    assert notes[-1] in shown
    assert sprint._notes.height() <= 6 * sprint._notes.fontMetrics().lineSpacing()
    assert sprint._notes.verticalScrollBar().maximum() > 0
    assert sprint.plot.height() > sprint._notes.height()
