"""Histograms of latencies with few counts, with outliers and without any."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
from PySide6.QtWidgets import QApplication
from scripted import ScriptedSource, counted
from test_calibrate_panels import labels

from escape_gui.main_window import MainWindow
from escape_gui.panels.latency import LatencyPanel
from escape_gui.widgets.plots import Plot
from escape_hw.remote.state import LatencyState

RNG = np.random.default_rng(0)
FEW = ((312.0,), (312.0, 340.0), tuple(RNG.gamma(60, 5.2, 100)), tuple(RNG.gamma(60, 5.2, 4000)))


@pytest.fixture
def panel(make_window: Callable[..., MainWindow]) -> LatencyPanel:
    panel = make_window((LatencyPanel,)).panels["latency"]
    assert isinstance(panel, LatencyPanel)
    return panel


def show(panel: LatencyPanel, source: ScriptedSource, *microseconds: float) -> Plot:
    """Show these latencies; returns the plot."""
    source.push("latency_histogram", np.stack([counted(*microseconds), counted()]))
    panel.refresh_from(source)
    QApplication.processEvents()
    panel.grab()
    return panel.plots[0]


def numbers(plot: Plot, side: str) -> list[str]:
    axis = plot.getAxis(side)
    low, high = axis.range
    size = axis.size().height() if side == "left" else axis.size().width()
    return [
        text
        for step, values in axis.tickValues(low, high, size)
        for text in axis.tickStrings(values, 1, step)
    ]


@pytest.mark.parametrize("microseconds", FEW, ids=len)
@pytest.mark.parametrize("size", [(330, 200), (640, 260)])
def test_the_numbers_of_frames_are_whole_and_apart(
    panel: LatencyPanel, source: ScriptedSource, size: tuple[int, int], microseconds: tuple[float, ...]
) -> None:
    panel.window().resize(1600, 1000)
    panel.setFixedSize(*size)
    plot = show(panel, source, *microseconds)
    assert "1" in numbers(plot, "left")
    assert all(text.isdecimal() for text in numbers(plot, "left"))
    for side in ("left", "bottom"):
        places = sorted(labels(plot.getAxis(side)), key=lambda one: (one.left(), one.top()))
        assert places
        apart = (not a.intersects(b) for a, b in pairwise(places))
        assert all(apart), f"numbers of the {side} axis overlap"


def test_an_outlier_does_not_stretch_the_axis(panel: LatencyPanel, source: ScriptedSource) -> None:
    plot = show(panel, source, *[312.0] * 40, 90_000.0)
    low, high = plot.viewRange()[0]
    assert (low > 280, high < 360) == (True, True)
    assert plot._beyond.textItem.toPlainText() == "1 of 41 beyond"
    show(panel, source, *[312.0] * 40)
    assert plot._beyond.textItem.toPlainText() == ""


def test_without_frames_there_are_no_numbers(panel: LatencyPanel, source: ScriptedSource) -> None:
    plot = show(panel, source)
    assert not labels(plot.getAxis("left"))
    assert not labels(plot.getAxis("bottom"))
    source.change(latency=LatencyState())
    panel.refresh_from(source)
    assert {one.text for one in panel.readouts.values()} == {"–"}
