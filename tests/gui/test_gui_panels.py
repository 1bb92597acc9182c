"""All panels in all states of their source, and the content of single panels."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np
import pytest
from PySide6.QtCore import Qt
from PySide6.QtGui import QFontMetricsF, QGuiApplication
from PySide6.QtWidgets import QApplication
from pytestqt.qtbot import QtBot
from scripted import DEVICES, ScriptedSource, running, secondary

from escape_gui.client.history import LoopHistory
from escape_gui.client.session import Session
from escape_gui.main_window import MainWindow
from escape_gui.panels import PANELS
from escape_gui.panels.base import Panel
from escape_gui.panels.camera import CameraPanel
from escape_gui.panels.devices import DevicesPanel, format_fact
from escape_gui.panels.latency import LatencyPanel
from escape_gui.panels.log import LogPanel
from escape_gui.panels.mirror import MirrorPanel
from escape_gui.panels.performance import PerformancePanel
from escape_gui.panels.psf import PsfPanel
from escape_gui.theme import Theme
from escape_gui.widgets.plots import Plot
from escape_hw.errors import StorageError
from escape_hw.remote.state import (
    DeviceHealth,
    Illumination,
    LoopState,
    MirrorState,
    Phase,
    State,
    StreamEntry,
)

P = TypeVar("P", bound=Panel)
MakeWindow = Callable[..., MainWindow]


@pytest.fixture
def window(make_window: MakeWindow) -> MainWindow:
    """A window with several panels."""
    return make_window((DevicesPanel, CameraPanel, MirrorPanel, PerformancePanel, LogPanel))


def panel_of(window: MainWindow, kind: type[P]) -> P:
    panel = window.panels[kind.name]
    assert isinstance(panel, kind)
    return panel


@pytest.mark.parametrize("kind", PANELS, ids=lambda kind: kind.name)
def test_each_panel_handles_all_states_of_the_source(
    kind: type[Panel], make_window: MakeWindow, source: ScriptedSource
) -> None:
    window = make_window((kind,))
    dock, panel = window.docks[kind.name], window.panels[kind.name]

    def look() -> DeviceHealth:
        window.update_timer.tick(force=True)
        assert window.update_timer.failed_panels == {}
        return panel.health

    assert look() is DeviceHealth.OK
    assert not dock._indicator.isVisible()
    source.fail()
    assert look() is DeviceHealth.FAULT
    assert dock._indicator.text == "fault"
    source.connected = False
    assert look() is DeviceHealth.LOST
    assert dock._indicator.text == "lost"
    source.connected = True
    source.state = running(engine_pid=99, serial=1000)
    source.push_all(1)
    assert look() is DeviceHealth.OK
    # An empty source, as before the first connection.
    source.state, source.streams, source.lines = State(), {}, []
    look()
    assert panel.shows_placeholder == bool(panel.placeholder) or kind.stale_after_s is None


def test_frames_that_stop_are_called_stale(
    window: MainWindow, source: ScriptedSource, monkeypatch: pytest.MonkeyPatch
) -> None:
    camera = panel_of(window, CameraPanel)
    assert camera.health is DeviceHealth.OK
    camera._last_sample_s -= 2.0
    window.update_timer.tick(force=True)
    assert camera.health is DeviceHealth.STALE
    assert window.docks["camera"]._indicator.text == "stale"
    source.push_all(5)
    window.update_timer.tick(force=True)
    assert camera.health is DeviceHealth.OK


def test_every_panel_has_a_help_text() -> None:
    for kind in PANELS:
        assert kind.title
        assert len(kind.help) > 40
        assert kind.rate_hz <= 30


def test_camera_counts_and_hatches_saturation(window: MainWindow, source: ScriptedSource) -> None:
    camera = panel_of(window, CameraPanel)
    frame = np.zeros((400, 400), np.uint16)
    frame[7, 9] = 1023
    source.push("frames", frame, full_scale=1023.0)
    source.change(illumination=Illumination(saturated=0.0321, peak=1.0))
    camera._histogram_due = 0.0
    window.update_timer.tick(force=True)
    assert "3.21 %" in camera.saturation.text()
    assert camera.image_view._marks.isVisible()
    assert np.argwhere(camera.image_view._marks.image[..., 3]).tolist() == [[7, 9]]


def test_camera_views(window: MainWindow, source: ScriptedSource) -> None:
    camera = panel_of(window, CameraPanel)
    kept = source.streams["frames"].data.astype(np.float32)
    camera.choice.choose("arrows")
    assert camera.quiver.isVisible()
    n = len(source.geometry_data.outlines_px)
    assert camera.quiver.getData()[0].size == 2 * n
    camera.choice.choose("x | y")
    maps = camera.signed.data
    assert maps is not None
    assert np.isfinite(maps).sum() == 2 * n
    camera.choice.choose("difference")
    source.push_all(3)
    window.update_timer.tick(force=True)
    assert camera.signed.data is not None
    assert np.array_equal(camera.signed.data, source.streams["frames"].data - kept)


def test_cursor_shows_position_and_value(window: MainWindow, source: ScriptedSource, qtbot: QtBot) -> None:
    image_view = panel_of(window, CameraPanel).image_view
    said: list[str] = []
    image_view.cursor_changed.connect(said.append)
    qtbot.keyClick(image_view, Qt.Key.Key_Right)
    value = source.streams["frames"].data[200, 201]
    assert said[-1].split() == ["x", "201", "y", "200", str(value), "counts"]


def test_mirror_of_a_secondary_shows_both(session: Session, make_window: MakeWindow) -> None:
    source = ScriptedSource(geometry=secondary())
    source.push_all()
    session.set_source(source, None)
    window = make_window((MirrorPanel,))
    mirror = panel_of(window, MirrorPanel)
    assert mirror.image_view.data is not None
    painted = mirror.image_view.data[np.isfinite(mirror.image_view.data)]
    assert set(np.unique(painted)) == set(source.streams["commands"].data.astype(np.float32))
    assert mirror.choice.buttons["measured"].isEnabled()
    mirror.choice.choose("measured")
    assert mirror.image_view.unit == "µm"


def test_mirror_shows_peak_and_clipping(window: MainWindow, source: ScriptedSource) -> None:
    source.change(mirror=MirrorState(rms=0.0812, peak=0.8, saturated_share=0.031))
    window.show_workspace("align")
    window.update_timer.tick(force=True)
    readouts = panel_of(window, MirrorPanel).readouts
    assert [readouts[name].text for name in ("rms", "peak", "clipped")] == ["0.0812", "0.8000", "3.10"]


def test_the_log_shows_local_time(
    window: MainWindow, source: ScriptedSource, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TZ", "Pacific/Honolulu")
    time.tzset()
    try:
        log = panel_of(window, LogPanel)
        log.apply_theme()
        # 21:00 UTC.
        assert log.text.toPlainText().startswith("11:00:0")
    finally:
        monkeypatch.undo()
        time.tzset()


def test_log_search_level_and_copy(window: MainWindow, source: ScriptedSource) -> None:
    for k in range(1, 7):
        source.push_all(k)
    log = panel_of(window, LogPanel)
    window.update_timer.tick(force=True)
    assert len(log.text.toPlainText().splitlines()) == 7
    log.level.setCurrentText("Warning")
    assert len(log.text.toPlainText().splitlines()) == 4
    log.search.setText("GAIN message 4")
    assert log.text.toPlainText().split()[1] == "WARNING"
    log.copy_button.click()
    assert "message 4" in QGuiApplication.clipboard().text()


def test_performance_goes_on_while_the_panel_is_hidden(window: MainWindow, source: ScriptedSource) -> None:
    panel = panel_of(window, PerformancePanel)
    window.show_workspace("align")
    for residual in (50.0, 51.0):
        source.change(loop=source.state.loop.model_copy(update={"residual_nm": residual}))
        window.update_timer.tick(force=True)
    window.show_workspace("operate")
    (table,) = panel.export_arrays()
    assert table.data[-3:, 2].tolist() == [44.0, 50.0, 51.0]


def test_performance_has_gaps_where_the_loop_was_open(window: MainWindow, source: ScriptedSource) -> None:
    panel = panel_of(window, PerformancePanel)
    source.change(loop=source.state.loop.model_copy(update={"closed": False}))
    window.update_timer.tick(force=True)
    (table,) = panel.export_arrays()
    assert table.data[-2, 1:] == pytest.approx([36.5, 44.0])
    assert np.isnan(table.data[-1, 1:]).all()


def test_performance_survives_the_end_of_the_engine(window: MainWindow, source: ScriptedSource) -> None:
    panel = panel_of(window, PerformancePanel)
    source.fail("the engine died")
    source.change(engine_pid=0)
    window.update_timer.tick(force=True)
    source.change(engine_pid=12, fault=None, phase=Phase.IDLE)
    window.update_timer.tick(force=True)
    assert not panel.shows_placeholder
    (table,) = panel.export_arrays()
    assert table.data[1, 1:] == pytest.approx([36.5, 44.0])


@pytest.mark.slow
def test_hours_of_performance_need_little_memory_and_are_shown_in_hours(
    window: MainWindow, source: ScriptedSource
) -> None:
    seconds = iter(np.arange(0, 9 * 3600, 0.2))
    history = LoopHistory(clock=lambda: float(next(seconds)))
    loop = source.state.loop
    for serial in range(9 * 3600 * 5):
        history.update(State.model_construct(system="a", server_pid=1, serial=serial + 1, loop=loop))
    times, _ = history.strehl.arrays
    assert times.size >= 8 * 3600 * 5
    assert sum(one.nbytes for one in vars(history.strehl).values() if hasattr(one, "nbytes")) < 10e6
    panel = panel_of(window, PerformancePanel)
    panel.span.choose("12 h")
    panel.strehl.show_history(history.strehl, times[-1])
    assert panel.strehl.getPlotItem().getAxis("bottom").labelText == "time before now [h]"
    assert panel.strehl._line.getData()[0].size < 10_000


def test_profiles_begin_at_the_strehl_ratio(make_window: MakeWindow, source: ScriptedSource) -> None:
    y, x = np.indices((64, 64)) - 32.0
    narrow = np.exp(-(x**2 + y**2) / 8)
    wide = np.exp(-(x**2 + y**2) / 32) / 4
    source.push("model_psf", 1000 * narrow)
    source.push("psf", (50 + 3000 * wide).astype(np.uint16))
    window = make_window((PsfPanel,))
    profiles = {one.name: one.data for one in panel_of(window, PsfPanel).export_arrays()}
    assert profiles["psf_profile"][0] / profiles["model_psf_profile"][0] == pytest.approx(0.25, rel=0.01)


def test_latencies_are_exported_by_bin(make_window: MakeWindow, source: ScriptedSource) -> None:
    window = make_window((LatencyPanel,))
    (table,) = panel_of(window, LatencyPanel).export_arrays()
    assert table.data[:, 1].sum() == 4000
    middle = table.data[:, 0] @ table.data[:, 1] / 4000
    assert middle == pytest.approx(60 * 5.2, rel=0.05)


def test_devices_are_listed_with_units(window: MainWindow, source: ScriptedSource) -> None:
    panel = panel_of(window, DevicesPanel)
    window.show_workspace("align")
    window.update_timer.tick(force=True)
    assert list(panel._rows) == [device.name for device in DEVICES]
    source.change(devices=DEVICES[:1])
    window.update_timer.tick(force=True)
    assert list(panel._rows) == ["dm"]


@pytest.mark.parametrize(
    ("key", "value", "text"),
    [
        ("temperature_c", 31.24, "temperature 31.2 °C"),
        ("link", "USB 3", "link USB 3"),
        ("unread", 4.0, "unread 4"),
    ],
)
def test_format_of_facts(key: str, value: float | str, text: str) -> None:
    assert format_fact(key, value) == text
    assert format_fact(key, value, simulated=True) == text


def test_the_frame_rate_of_a_twin_is_marked() -> None:
    assert format_fact("frame_rate_hz", 500.0) == "frame rate 500.0 Hz"
    assert format_fact("frame_rate_hz", 500.0, simulated=True) == "simulated frame rate 500.0 Hz"


def test_a_full_disk_is_notified(window: MainWindow, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path, content: bytes) -> None:
        raise StorageError(f"{path}: cannot be written (No space left on device)")

    monkeypatch.setattr("escape_gui.window.export.write_atomic", full)
    window.exporter.save_panel_to(tmp_path / "a.png", "png", window.panels["camera"])
    assert "No space left" in window.notifications.notifications[-1].text
    assert list(tmp_path.glob("a*")) == []


def test_a_missing_reference_psf_is_shown(make_window: MakeWindow, source: ScriptedSource) -> None:
    model = source.streams.pop("model_psf")
    source.change(loop=LoopState(closed=True, matrix="escape", residual_nm=50.0))
    window = make_window((PsfPanel, PerformancePanel))
    psf, performance = panel_of(window, PsfPanel), panel_of(window, PerformancePanel)
    window.docks["psf"].raise_()
    window.update_timer.tick(force=True)
    assert psf.captions["model_psf"].text() == "no reference PSF"
    assert "'Model PSF' measures it" in psf.captions["model_psf"].toolTip()
    assert performance.readouts["strehl"].text == "–"
    assert performance.reference_missing_label.isVisible()
    source.streams["model_psf"] = model
    source.change(streams=(StreamEntry(name="model_psf", segment="", unit=""),))
    window.update_timer.tick(force=True)
    assert psf.captions["model_psf"].text() == "PSF: reference (- -)"
    assert not performance.reference_missing_label.isVisible()


def test_a_chart_without_data_has_a_plain_axis_and_a_low_one_a_short_title(
    window: MainWindow, qtbot: QtBot
) -> None:
    panel = panel_of(window, PerformancePanel)
    panel.show_placeholder(False)
    panel.strehl.show_history(LoopHistory().strehl, 0.0)
    assert panel.strehl.getPlotItem().getViewBox().viewRange()[1][1] >= 100
    for height, title in ((400, "residual [nm rms]"), (90, "[nm rms]")):
        panel.residual.setFixedHeight(height)
        qtbot.waitUntil(lambda title=title: panel.residual.getAxis("left").labelText == title)


def test_the_scale_of_a_mirror_without_commands_is_flat(window: MainWindow, source: ScriptedSource) -> None:
    panel = panel_of(window, MirrorPanel)
    assert panel.scale.text().startswith("±")
    source.push("commands", np.zeros_like(source.latest("commands").data))
    window.update_timer.tick(force=True)
    assert panel.scale.text() == "flat"


def test_numbers_below_a_narrow_plot_do_not_overlap(qapp: QApplication) -> None:
    plot = Plot(Theme(), "Latencies", "latency [µs]", "frames")
    axis = plot.getAxis("bottom")
    metrics = QFontMetricsF(axis.style["tickFont"])
    for width in (90, 130, 400):
        for high in (500, 9000, 24_000, 120_000):
            spacing, values = axis.tickValues(0, high, width)[0]
            texts = axis.tickStrings(values, 1.0, spacing)
            assert texts
            assert sum(map(metrics.horizontalAdvance, texts)) < width
    plot.close()
    plot.deleteLater()
