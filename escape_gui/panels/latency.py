"""Histograms of the loop's latency and of the frame interval."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from escape_gui.panels.base import Context, ExportArray, Panel
from escape_gui.widgets.controls import Readout, readout_grid, row
from escape_gui.widgets.plots import Plot
from escape_hw.remote.source import Sample
from escape_hw.remote.state import State
from escape_hw.streams.timing import MIDDLES, percentiles_of

#: Percentiles at the ends of the axis; the largest value is shown as a number.
_SHOWN_PERCENTILES = (0.0, 99.9)


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
            Plot(theme, "Histogram of latencies", "latency [µs]", "frames"),
            Plot(theme, "Histogram of frame intervals", "frame interval [µs]", "frames"),
        )
        self._curves = []
        for number, plot in enumerate(self.plots):
            plot.setLogMode(x=False, y=True)
            # Room for the upper half of the highest tick label.
            plot.getPlotItem().layout.setContentsMargins(1, 8, 1, 1)
            self._curves.append(plot.curve(number, alone=True, stepMode="center", connect="finite"))
        self.body.addLayout(readout_grid(self.readouts))
        self.body.addLayout(row(*((plot, 1) for plot in self.plots)), 1)
        self._counts: NDArray[Any] | None = None

    def on_state(self, state: State) -> None:
        for name, readout in self.readouts.items():
            value = getattr(state.latency, name)
            readout.show_value(f"{value:.0f}" if np.isfinite(value) else "–")

    def on_sample(self, stream: str, sample: Sample) -> None:
        self._counts = sample.data
        for plot, curve, counts in zip(self.plots, self._curves, sample.data, strict=True):
            used = np.flatnonzero(counts)
            if used.size == 0:
                curve.setData([1.0, 2.0], [np.nan])
                continue
            first, last = max(int(used[0]) - 1, 1), min(int(used[-1]) + 2, MIDDLES.size - 1)
            middles = MIDDLES[first - 1 : last + 1] / 1e3
            edges = (middles[:-1] + middles[1:]) / 2
            # 0.5 instead of zero, for the logarithmic axis.
            curve.setData(edges, np.maximum(counts[first:last], 0.5))
            low, high = percentiles_of(counts, _SHOWN_PERCENTILES) / 1e3
            plot.setXRange(float(low) * 0.95, float(high) * 1.05)

    def clear(self) -> None:
        self._counts = None

    def export_arrays(self) -> tuple[ExportArray, ...]:
        if self._counts is None:
            return ()
        used = np.flatnonzero(self._counts.sum(axis=0))
        part = slice(int(used[0]), int(used[-1]) + 1) if used.size else slice(0)
        table = np.column_stack([MIDDLES[part] / 1e3, self._counts[0, part], self._counts[1, part]])
        return (ExportArray("latency", table, "", ("middle [us]", "latency [frames]", "spacing [frames]")),)
