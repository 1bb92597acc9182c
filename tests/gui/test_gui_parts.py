"""Theme, settings, requests, maps, and the command: everything except panels and window."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
from PySide6.QtCore import Qt
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QApplication
from pytestqt.qtbot import QtBot
from scripted import ScriptedControl, disc, rows_of, secondary

from escape_gui.app import require_display
from escape_gui.client.history import TimeSeriesBuffer
from escape_gui.client.session import EmptySource, Session
from escape_gui.settings import Settings, load_settings, save_settings
from escape_gui.theme import PALETTES, SCALES, Palette, Theme
from escape_gui.views.images import MAP_GAP, ActuatorImage, RadialProfile, mask_from_rows, slope_map_pair
from escape_gui.views.loop_form import LoopSettingsEdit
from escape_gui.widgets.images import SEQUENTIAL_MAPS, ImageViewer, outline_points
from escape_hw.cli.app import run
from escape_hw.errors import ConfigError, ServerGone
from escape_hw.remote.state import Geometry, LoopState

SURFACES = ("window", "panel", "field")
TEXTS = ("text", "muted", "accent", "good", "warn", "bad")
PAIRS = (
    ("on_accent", "accent"),
    ("on_simulated", "simulated"),
    ("on_hardware", "hardware"),
    ("on_stop", "stop"),
    ("text", "button"),
)


def contrast(one: str, other: str) -> float:
    """Contrast ratio of two colours, from 1 to 21 (Web Content Accessibility Guidelines 2.2, 1.4.3)."""
    bright, dim = sorted((_luminance(one), _luminance(other)), reverse=True)
    return (bright + 0.05) / (dim + 0.05)


def _luminance(colour: str) -> float:
    """Relative luminance of an sRGB colour, 0 to 1 (same source)."""
    channels = (int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5))
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in channels]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


@pytest.mark.parametrize("colours", PALETTES.values(), ids=PALETTES.keys())
def test_every_text_can_be_read(colours: Palette) -> None:
    pairs = [(text, surface) for text in TEXTS for surface in SURFACES]
    poor = {
        (front, back): round(contrast(getattr(colours, front), getattr(colours, back)), 2)
        for front, back in (*pairs, *PAIRS)
        if contrast(getattr(colours, front), getattr(colours, back)) < 4.5
    }
    assert poor == {}


@pytest.mark.parametrize("colours", PALETTES.values(), ids=PALETTES.keys())
def test_curves_contrast_with_their_background(colours: Palette) -> None:
    assert min(contrast(colour, colours.field) for colour in colours.series) >= 3.0


def test_contrast_is_that_of_the_guidelines() -> None:
    assert contrast("#000000", "#ffffff") == pytest.approx(21.0)
    assert contrast("#777777", "#ffffff") == pytest.approx(4.48, abs=0.01)


def test_font_scale_changes_in_steps_within_limits(qtbot: QtBot) -> None:
    theme = Theme()
    for _ in range(20):
        theme.step_scale(+1)
    assert theme.scale == SCALES[-1]
    assert theme.pixels(10) == round(10 * SCALES[-1])
    theme.step_scale(0)
    assert theme.scale == 1.0


# ---------------------------------------------------------------- settings
@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("{", "cannot be read"),
        ("[]", "not a table"),
        ('{"font_scael": 1.2}', "did you mean 'font_scale'"),
        ('{"font_scale": 9}', "setting 'font_scale' is ignored"),
        ('{"theme": "pink"}', "setting 'theme' is ignored"),
    ],
)
def test_damaged_settings_never_stop_the_start(tmp_path: Path, content: str, said: str) -> None:
    path = tmp_path / "gui.json"
    path.write_text(content)
    settings, (warning,) = load_settings(path)
    assert settings == Settings()
    assert said in warning
    assert str(path) in warning


def test_sound_settings_survive_beside_damaged_ones(tmp_path: Path) -> None:
    path = tmp_path / "gui.json"
    path.write_text(json.dumps({"theme": "light", "font_scale": "large"}))
    settings, warnings = load_settings(path)
    assert settings.theme == "light"
    assert len(warnings) == 1
    save_settings(path, settings)
    assert load_settings(path) == (settings, ())


def test_a_missing_settings_file_gives_no_warning(tmp_path: Path) -> None:
    assert load_settings(tmp_path / "none.json") == (Settings(workspace="align"), ())


# ---------------------------------------------------------------- requests
@pytest.fixture
def requests(control: ScriptedControl):
    session = Session()
    session.set_source(EmptySource(), control)
    yield session
    session.close()


def test_answers_are_delivered_in_the_windows_thread(requests: Session, qtbot: QtBot) -> None:
    threads: list[threading.Thread] = []
    asked = threading.current_thread()

    def call(server: object) -> str:
        threads.append(threading.current_thread())
        return "done"

    def on_result(answer: str) -> None:
        threads.append(threading.current_thread())
        assert answer == "done"

    requests.ask("try", call, on_result)
    qtbot.waitUntil(lambda: len(threads) == 2)
    assert threads[0] is not asked
    assert threads[1] is asked


def test_safety_does_not_wait_behind_a_slow_question(
    requests: Session, control: ScriptedControl, qtbot: QtBot
) -> None:
    go_on = threading.Event()
    requests.ask("check", lambda server: go_on.wait(20))
    requests.ask("flatten", lambda server: server.flatten(), urgent=True)
    qtbot.waitUntil(lambda: control.verbs == ["flatten"])
    assert not go_on.is_set()
    go_on.set()


def test_a_failure_is_reported_to_the_caller(
    requests: Session, control: ScriptedControl, qtbot: QtBot
) -> None:
    control.refuse = "the loop is open"
    heard: list[str] = []
    with qtbot.waitSignal(requests.failed) as told:
        requests.ask("change the loop", lambda server: server.set_loop(gain=0.5), on_error=heard.append)
    assert told.args == ["change the loop", "the loop is open"]
    assert heard == ["the loop is open"]


def test_answers_after_closing_are_discarded(control: ScriptedControl, qtbot: QtBot) -> None:
    requests = Session()
    requests.set_source(EmptySource(), control)
    go_on, heard = threading.Event(), []
    requests.ask("slow", lambda server: go_on.wait(20), heard.append)
    go_on.set()
    requests.close()
    requests.ask("late", lambda server: server.flatten(), heard.append)
    qtbot.wait(50)
    assert heard == []
    assert control.asked == []


def test_a_new_connection_does_not_wait_for_answers_of_the_one_before(
    requests: Session, control: ScriptedControl, qtbot: QtBot
) -> None:
    go_on, ended, heard = threading.Event(), threading.Event(), []

    def call(server: object) -> None:
        go_on.wait(20)
        ended.set()
        raise ServerGone("no reply to 'flatten' within 30 s")

    requests.ask("flatten the mirror", call, heard.append, heard.append, urgent=True)
    requests.ask("plan", lambda server: go_on.wait(20), heard.append, heard.append)
    assert requests._pending == 2
    again = ScriptedControl()
    requests.set_source(EmptySource(), again)
    assert not ended.is_set()
    assert requests._pending == 0
    requests.ask("flatten the mirror", lambda server: server.flatten(), urgent=True)
    qtbot.waitUntil(lambda: again.verbs == ["flatten"])
    # The request without an answer is reported as failed; a late answer is discarded.
    with qtbot.waitSignal(requests.failed) as told:
        go_on.set()
    assert told.args[0] == "flatten the mirror"
    assert "repeat if necessary" in told.args[1]
    assert heard == [told.args[1]]


# ---------------------------------------------------------------- pictures
def test_slopes_become_two_maps() -> None:
    valid = disc(5)
    n = int(valid.sum())
    maps = slope_map_pair(np.arange(2.0 * n), valid)
    assert maps.shape == (5, 10 + MAP_GAP)
    assert maps[:, :5][valid].tolist() == list(range(n))
    assert maps[:, 5 + MAP_GAP :][valid].tolist() == list(range(n, 2 * n))
    assert int(np.isfinite(maps).sum()) == 2 * n


def test_geometry_without_a_sensor_has_an_empty_mask() -> None:
    assert mask_from_rows(()).size == 0


def test_actuators_on_a_grid_have_a_square_each() -> None:
    mask = disc(11, 1.03)
    chart = ActuatorImage(Geometry(layout=rows_of(mask)))
    values = np.arange(chart.n_act, dtype=float)
    assert chart.n_act == int(mask.sum())
    image = chart.to_image(values)
    assert image[mask].tolist() == values.tolist()
    assert np.isnan(image[~mask]).all()


def test_actuators_without_a_grid_are_at_their_positions() -> None:
    places = secondary().positions_m
    chart = ActuatorImage(Geometry(positions_m=places))
    image = chart.to_image(np.array([x for x, _ in places]))
    # Values increase to the right like the positions, and every actuator is visible.
    rows, columns = np.nonzero(np.isfinite(image))
    assert np.corrcoef(columns, image[rows, columns])[0, 1] > 0.99
    assert set(np.unique(chart.numbers)) == {-1, *range(len(places))}


def test_radial_profile_of_a_cone() -> None:
    y, x = np.indices((41, 41)) - 20.0
    profile = RadialProfile((41, 41), (20, 20))(np.hypot(x, y))
    assert profile.size == 20
    assert profile[0] == 0
    assert np.abs(profile - np.arange(20)).max() < 0.3


def test_outlines_of_lenslets_are_squares_and_of_pupils_circles() -> None:
    squares = outline_points([(float(x), 0.0, 2.0) for x in range(20)])
    assert np.nanmax(np.abs(squares[1])) == pytest.approx(2.0)
    assert np.isnan(squares[0]).sum() == 20
    circle = outline_points([(0.0, 0.0, 3.0)])
    assert np.hypot(*circle[:, :-1]) == pytest.approx(3.0)


def test_history_discards_the_oldest() -> None:
    history = TimeSeriesBuffer(4)
    for k in range(11):
        history.add(float(k), 10.0 * k)
    times, values = history.arrays
    assert times.tolist() == [7, 8, 9, 10]
    assert values.tolist() == [70, 80, 90, 100]
    history.clear()
    assert history.arrays[0].size == 0


def test_what_an_edit_changes() -> None:
    loop = LoopState(matrix="escape", gain=0.4, leak=0.02, dropped_modes=3, n_modes=80)
    assert LoopSettingsEdit("escape", 0.4, 0.02, 3).changed(loop) == {}
    edit = LoopSettingsEdit("docrime", 0.4, 0.02, 5)
    assert edit.changed(loop) == {"matrix": "docrime", "dropped_modes": 5}
    assert edit.describe_changes(loop) == "matrix escape → docrime, dropped modes 3 → 5"
    assert edit.validation_errors(loop) == ()
    assert LoopSettingsEdit("escape", 0.4, 0.02, 83).validation_errors(loop) != ()


# ---------------------------------------------------------------- the command
def test_a_system_and_an_address_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        run(["gui", "razor-shwfs", "--connect", "tcp://bench:5555"])
    assert ended.value.code == 2
    assert "not both" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("display", "said"), [("", "ssh -X"), (":0", "apt install libxcb-cursor0 libxcb-icccm4")]
)
def test_without_a_display_the_message_names_the_remedy(
    monkeypatch: pytest.MonkeyPatch, display: str, said: str
) -> None:
    for name in ("QT_QPA_PLATFORM", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("DISPLAY", display)
    monkeypatch.setattr("escape_hw.runtime.host.doctor._can_load", lambda name: False)
    with pytest.raises(ConfigError, match=said):
        require_display()
    monkeypatch.setenv("QT_QPA_PLATFORM", "offscreen")
    require_display()


def test_qt_keeps_its_references() -> None:
    """PySide6 6.12.0 on Python < 3.12 loses a reference with every signal and aborts after some thousands."""
    code = (
        "from PySide6.QtCore import QObject, Signal\n"
        "class Bell(QObject):\n    rung = Signal(bool)\n"
        "bell = Bell()\nfor _ in range(5000): bell.rung.emit(True)\n"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False, timeout=120).returncode == 0


def test_a_double_click_resets_the_zoom_of_an_image(qapp: QApplication) -> None:
    image = ImageViewer(Theme(), "image", SEQUENTIAL_MAPS)
    image.resize(300, 300)
    image.show()
    image.show_array(np.zeros((40, 40)))
    QApplication.processEvents()
    whole = image.box.viewRect()
    image.box.setRange(xRange=(5, 10), yRange=(5, 10))
    assert image.box.viewRect().width() < 0.5 * whole.width()
    place = image.view.viewport().rect().center()
    QTest.mouseDClick(image.view.viewport(), Qt.MouseButton.LeftButton, pos=place)
    QApplication.processEvents()
    assert image.box.viewRect().width() == pytest.approx(whole.width())
    image.close()
    image.deleteLater()
