"""Histograms of the loop's latency and of the frame interval."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from escape_gui.client.availability import UNKNOWN_VALUE
from escape_gui.panels.base import Context, ExportArray, Panel
from escape_gui.widgets.controls import Readout, readout_grid, row
from escape_gui.widgets.histogram_plot import HistogramPlot
from escape_hw.remote.source import Sample
from escape_hw.remote.state import State
from escape_hw.streams.timing import MIDDLES


class LatencyPanel(Panel):
    """Histograms of all frames since the loop was closed, counted by the loop."""

    name: ClassVar[str] = "latency"
    title: ClassVar[str] = "Latency"
    help: ClassVar[str] = (
        "Latency from frame received to command sent, and interval between frames, of all frames since the "
        "loop was closed. The numbers above the plots are for the last second. Jitter: deviation of the "
        "frame interval from its median, 99th percentile."
    )
    streams: ClassVar[tuple[str, ...]] = ("latency_histogram",)
    rate_hz: ClassVar[float] = 2.0
    placeholder: ClassVar[str] = "No data yet.\nLatencies are recorded while the loop is closed."

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        theme = context.theme
        self.readouts = {
            "p50": Readout(theme, "median", "µs", 6),
            "p99": Readout(theme, "p99", "µs", 6),
            "max": Readout(theme, "largest", "µs", 6),
            "jitter_p99": Readout(theme, "jitter p99", "µs", 6),
        }
        self.plots = (
            HistogramPlot(theme, "Histogram of latencies", "latency [µs]", 0),
            HistogramPlot(theme, "Histogram of frame intervals", "interval [µs]", 1),
        )
        self.body.addLayout(readout_grid(self.readouts))
        self.body.addLayout(row(*((plot, 1) for plot in self.plots)), 1)
        self._counts: NDArray[Any] | None = None

    def on_state(self, state: State) -> None:
        # Zero if no command was sent in the last second.
        measured = state.latency.p99 > 0
        for name, readout in self.readouts.items():
            readout.show_value(f"{getattr(state.latency, name):.0f}" if measured else UNKNOWN_VALUE)

    def on_sample(self, stream: str, sample: Sample) -> None:
        self._counts = sample.data
        for plot, counts in zip(self.plots, sample.data, strict=True):
            plot.show_counts(counts)

    def clear(self) -> None:
        self._counts = None

    def export_arrays(self) -> tuple[ExportArray, ...]:
        if self._counts is None:
            return ()
        used = np.flatnonzero(self._counts.sum(axis=0))
        part = slice(int(used[0]), int(used[-1]) + 1) if used.size else slice(0)
        table = np.column_stack([MIDDLES[part] / 1e3, self._counts[0, part], self._counts[1, part]])
        return (ExportArray("latency", table, "", ("middle [us]", "latency [frames]", "spacing [frames]")),)
